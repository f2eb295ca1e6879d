"""What MkDocs runs while it builds the site: the page of commands is made from the commands' own
help, so that it can't tell another story.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer.main

from knotgym.cli.main import app

MARK = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put every command where a page has the mark."""
    return markdown.replace(MARK, "\n".join(pages())) if MARK in markdown else markdown


def pages() -> Iterator[str]:
    """Markdown of every command, one after another."""
    for name, command in commands("knotgym", typer.main.get_command(app)):
        yield f"## `{name}`\n"
        yield f"{_paragraphs(command.help)}\n"
        yield f"```text\n{_usage(name, command)}\n```\n"
        yield "| argument or option | default | what it says |\n| --- | --- | --- |"
        for parameter in command.params:
            yield _row(parameter)
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


def _row(parameter: Any) -> str:
    if _is_argument(parameter):
        name = parameter.metavar or parameter.name.upper()
    else:
        name = " / ".join([", ".join(parameter.opts), *parameter.secondary_opts])
    said = _flowed(parameter.help).replace("|", "\\|")
    return f"| `{name}` | {_default(parameter)} | {said} |"


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if isinstance(value, bool):
        return "on" if value else "off"
    return "" if value in (None, "") or callable(value) else f"`{value}`"


def _is_argument(parameter: Any) -> bool:
    return str(parameter.param_type_name) == "argument"


def _paragraphs(text: str | None) -> str:
    """A help text in Markdown, its examples as code."""
    parts = [_flowed(part) for part in (text or "").split("\n\n")]
    return "\n\n".join(f"    {part}" if part.startswith("knotgym ") else part for part in parts)


def _flowed(text: str | None) -> str:
    """A help text in one line, as prose."""
    return " ".join((text or "").split())
