"""Write the commands' own help into docs/commands.md, below its mark.

    python docs/commands.py

A test compares the page with the commands.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from knotgym.cli.main import application

PAGE = Path(__file__).with_suffix(".md")
MARK = "<!-- commands -->\n"


def whole_page() -> str:
    """The page as it should be: what stands above the mark, and every command."""
    head = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    sections = [
        f"## `{' '.join(words)}`\n\n```text\n{help_of(words)}\n```\n" for words in commands()
    ]
    return head + MARK + "\n" + "\n".join(sections)


def commands() -> Iterator[tuple[str, ...]]:
    """The words of every command that does something, such as ("knotgym", "dataset", "show")."""

    def below(words: tuple[str, ...], app: Any) -> Iterator[tuple[str, ...]]:
        names = sorted(name for name in app if not name.startswith("-"))
        for name in names:
            yield from below((*words, name), app[name])
        if not names:
            yield words

    yield from below(("knotgym",), application())


def help_of(words: tuple[str, ...]) -> str:
    """What `--help` of a command prints, without frames."""
    out = io.StringIO()
    console = Console(file=out, width=98, force_terminal=False, legacy_windows=False)
    application()([*words[1:], "--help"], console=console, result_action="return_value")
    lines = (line.strip("╭╮╰╯│─").rstrip() for line in out.getvalue().splitlines())
    return "\n".join(lines).strip("\n")


if __name__ == "__main__":
    PAGE.write_text(whole_page(), encoding="utf-8")
