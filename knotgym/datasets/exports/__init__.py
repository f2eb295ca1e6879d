"""Export datasets to other formats: compact, LeRobot, OGBench, Hugging Face, Minari."""
