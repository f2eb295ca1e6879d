"""Write tables into the pages, below marks: columns of schemas, and the rooms of the package.

    python docs/schemas.py

A mark is a line such as `<!-- columns of knotgym.states.schema.STATES -->`, or `<!-- rooms -->`. A
test compares the pages with the schemas and with the first paragraphs of the rooms' doors.
"""

import importlib
import re
import tomllib
from pathlib import Path

_MARK = re.compile(r"(<!-- (?:columns of (\S+)\.(\w+)|rooms) -->\n)\n((?:\|.*\n)*)")
_ROOT = Path(__file__).parents[1]


def with_tables(text: str) -> str:
    """Return the text of a page with the tables as they should be."""

    def table(mark: re.Match[str]) -> str:
        made = rooms() if not mark[2] else getattr(importlib.import_module(mark[2]), mark[3]).page()
        return f"{mark[1]}\n{made}\n" + ("" if mark[4] else "\n")

    return _MARK.sub(table, text)


def rooms() -> str:
    """Return a table of the rooms, ground floor first, each with what its door says."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text("utf-8"))
    (floors,) = (
        contract["layers"]
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers"
    )
    lines = ["| room | what it is for |", "| --- | --- |"]
    for room in (room for floor in reversed(floors) for room in floor.split(" | ")):
        said = (importlib.import_module(room).__doc__ or "").partition("\n\n")[0]
        lines.append(f"| `{room}` | {' '.join(said.split())} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for page in (*Path(__file__).parent.rglob("*.md"), _ROOT / "CONTRIBUTING.md"):
        page.write_text(with_tables(page.read_text("utf-8")), "utf-8")
