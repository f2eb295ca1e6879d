"""Write the tables of columns into the pages, below marks that name their schemas.

    python docs/schemas.py

A mark is a line such as `<!-- columns of knotgym.states.schema.STATES -->`. A test compares the
pages with the schemas.
"""

import importlib
import re
from pathlib import Path

_MARK = re.compile(r"(<!-- columns of (\S+)\.(\w+) -->\n)\n((?:\|.*\n)*)")


def with_tables(text: str) -> str:
    """Return the text of a page with the tables as they should be."""

    def table(mark: re.Match[str]) -> str:
        schema = getattr(importlib.import_module(mark[2]), mark[3])
        return f"{mark[1]}\n{schema.page()}\n" + ("" if mark[4] else "\n")

    return _MARK.sub(table, text)


if __name__ == "__main__":
    for page in Path(__file__).parent.rglob("*.md"):
        page.write_text(with_tables(page.read_text("utf-8")), "utf-8")
