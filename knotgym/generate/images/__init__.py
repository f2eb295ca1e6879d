"""Labelled pictures: walks, selection, tables."""
