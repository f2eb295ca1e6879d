"""Dataset cards (README.md) from text templates, and CITATION.cff."""
