"""Episodes in other houses' forms."""
