"""Curated states: search, candidates, curation."""
