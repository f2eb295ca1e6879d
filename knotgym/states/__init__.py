"""Files of rope states: schema, reading, writing, splits, and the shipped sets."""
