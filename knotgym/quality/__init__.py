"""How good a state is: measures, limits, difficulty."""
