"""The names of the splits."""

STATE_SPLITS = ("train", "test")
# parts of "train" and "test" without a common diagram, see `States.rows`
CODE_SPLITS = ("train-code", "test-code")
