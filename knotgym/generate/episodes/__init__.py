"""Episodes: collection and evaluation."""
