"""Quality of states: measures, limits and difficulty of reading."""
