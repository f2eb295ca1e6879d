"""Write the commands' own help into docs/reference/commands.md, their list into docs/commands.md.

    python docs/commands.py

A test compares both with the commands.
"""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from knotgym.cli import application

DOCS = Path(__file__).parent
HELP = "reference/commands.md"
LIST = re.compile(r"(?<=<!-- commands -->\n\n)(?:\|.*\n)*")


def pages() -> dict[Path, str]:
    """Both pages as they should be: the list of commands, and the help of each of them."""
    overview = DOCS / "commands.md"
    rows = ["| command | what it does |", "| --- | --- |"]
    sections = ["# Help of the commands\n"]
    for words in commands():
        text = help_of(words)
        summary = text.split("\n\n")[1].replace("\n", " ")
        rows.append(f"| [`{' '.join(words)}`]({HELP}#{'-'.join(words)}) | {summary} |")
        sections.append(f"## `{' '.join(words)}`\n\n```text\n{text}\n```\n")
    listed = "\n".join(rows) + "\n"
    return {
        overview: LIST.sub(lambda _: listed, overview.read_text("utf-8")),
        DOCS / HELP: "\n".join(sections),
    }


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
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
