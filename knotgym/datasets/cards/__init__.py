"""Cards: what a person reads first of a set, and how to cite it."""
