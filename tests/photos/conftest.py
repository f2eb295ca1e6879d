"""Reading photos needs torch; drawing them doesn't."""

from importlib.util import find_spec

if not all(map(find_spec, ("torch", "safetensors"))):
    collect_ignore = ["test_rope_reader.py"]
