"""Action sequences, macro-actions, the planner, the expert, and policies by name."""
