"""Which tests of the page need viser."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("viser") else ["test_mouse.py", "test_page.py", "test_pictures.py"]
