"""Tables for a terminal of 80 columns, and for a pipe, which has as many."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich import box
from rich.table import Table


def narrow_table(
    columns: Iterable[str], title: str | None = None, left: Sequence[str] = ()
) -> Table:
    """A table without rules between columns, whose heads stay whole; words of the first column,
    if too long, go on below.
    """
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for place, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if column in left else "right",
            no_wrap=place > 0,
            overflow="fold",
        )
    return table
