"""Who acts and why: action sequences, macro-actions, the planner, policies and the expert."""
