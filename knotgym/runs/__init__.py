"""Long runs: executors, shards, staging folders and locks, progress, confidence intervals."""
