"""Write the commands' own help into docs/commands.md, below its mark.

    python docs/commands.py

A test compares the page with the commands.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from knotgym.cli.main import app

PAGE = Path(__file__).with_suffix(".md")
MARK = "<!-- commands -->\n"


def whole_page() -> str:
    """The page as it should be: what stands above the mark, and every command."""
    head = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    return head + MARK + "\n" + "\n".join(pages()).rstrip() + "\n"


def pages() -> Iterator[str]:
    """Markdown of every command, one after another."""
    for name, command in commands("knotgym", typer.main.get_command(app)):
        yield f"## `{name}`\n"
        yield f"{_paragraphs(command.help)}\n"
        yield f"```text\n{_usage(name, command)}\n```\n"
        yield from map(_item, command.params)
        yield ""


def commands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """Every command that does something, below a command or a group of them, by its whole name."""
    if not hasattr(command, "commands"):
        yield name, command
        return
    for word in sorted(command.commands):
        yield from commands(f"{name} {word}", command.commands[word])


def _usage(name: str, command: Any) -> str:
    wanted = [one.metavar or one.name.upper() for one in command.params if _is_argument(one)]
    return " ".join([name, "[OPTIONS]", *wanted])


def _item(parameter: Any) -> str:
    if _is_argument(parameter):
        name = parameter.metavar or parameter.name.upper()
    else:
        name = " / ".join([", ".join(parameter.opts), *parameter.secondary_opts])
    default = _default(parameter)
    return f"- `{name}`{default and f' ({default})'}: {_flowed(parameter.help)}"


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if isinstance(value, bool):
        return "on by default" if value else ""
    return "" if value in (None, "") or callable(value) else f"default `{value}`"


def _is_argument(parameter: Any) -> bool:
    return str(parameter.param_type_name) == "argument"


def _paragraphs(text: str | None) -> str:
    """A help text in Markdown, its examples as code."""
    parts = [_flowed(part) for part in (text or "").split("\n\n")]
    return "\n\n".join(f"    {part}" if part.startswith("knotgym ") else part for part in parts)


def _flowed(text: str | None) -> str:
    """A help text in one line, as prose."""
    return " ".join((text or "").split())


if __name__ == "__main__":
    PAGE.write_text(whole_page(), encoding="utf-8")
