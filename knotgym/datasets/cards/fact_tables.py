"""Tables of facts: in Markdown on cards, and on the terminal (`cli.summaries`)."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from knotgym.datasets.cards.citation import plain


class CardTable(NamedTuple):
    """A table.

    Attributes:
        title: its name.
        head: names of the columns.
        rows: the cells.
        says: what the columns hold.
        left: the columns of text.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[object]]
    says: str = ""
    left: Sequence[str] = ()

    def markdown(self) -> str:
        """Return the explanation of the columns, and the table; "" without rows."""
        if not self.rows:
            return ""
        says = f"{self.says[0].upper()}{self.says[1:]}.\n\n" if self.says else ""
        return says + "\n".join(table(self.head, [map(plain, row) for row in self.rows]))


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Format a Markdown table; return its lines.

    >>> table(("nx", "states"), [(3, 40)])
    ['| nx | states |', '| --- | --- |', '| 3 | 40 |']
    """
    return [f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *rows)]
