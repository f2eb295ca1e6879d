"""How long work is done: executors, shards, staging and locks, progress."""
