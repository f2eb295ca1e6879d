"""Tables for terminals of 80 columns; output to a pipe also has 80 columns."""

from collections.abc import Iterable, Sequence

from rich import box
from rich.table import Table


def narrow_table(
    columns: Iterable[str], title: str | None = None, left: Sequence[str] = ()
) -> Table:
    """Make a table without vertical rules; only the first column may wrap."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if column in left else "right",
            no_wrap=index > 0,
            overflow="fold",
        )
    return table
