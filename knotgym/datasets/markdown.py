"""Tables of the dataset cards, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table_row(*cells: object) -> str:
    """One row.

    >>> table_row("nx", 3)
    '| nx | 3 |'
    """
    return "| " + " | ".join(map(str, cells)) + " |"


def table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a table."""
    return [
        table_row(*head),
        table_row(*["---"] * len(head)),
        *(table_row(*row) for row in rows),
    ]
