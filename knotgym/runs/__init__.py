"""Long runs: recipes and their journal, executors, progress, confidence intervals."""
