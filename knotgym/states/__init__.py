"""Files of rope states: schema, reading, writing, splits; the curated sets that ship."""
