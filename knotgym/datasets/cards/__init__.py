"""Dataset cards (README.md): their templates, tables of facts and citation, and escaped text."""

import html
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import knotgym

BIBTEX = """\
@misc{knotgym,
  title  = {knotgym: curated states, trajectories and labelled pictures of a closed rope},
  author = {{The knotgym founders}},
  year   = {2026},
  note   = {after "Knot So Simple", arXiv:2505.18028}
}"""
TO_CITE = ("## To cite", "", "```bibtex", BIBTEX, "```", "")  # lines of a card
_LISTED = 24  # entries of a mapping in words, at most


def plain(text: object) -> str:
    """Escape untrusted text for Markdown: one line, without HTML, markup, links or mentions.

    >>> print(plain("<b>[a|b](http://c)"))
    &lt;b&gt;\\[a\\|b\\](http&#58;//c)
    """
    escaped = html.escape(_one_printable_line(text), quote=False)
    escaped = re.sub(r"([\\`*_\[\]|~$])", r"\\\1", escaped)
    # GitHub and Hugging Face turn bare URLs and mentions into links
    escaped = escaped.replace("://", "&#58;//").replace("@", "&#64;")
    return re.sub(r"(?i)\b(www)\.", r"\1&#46;", escaped)


def code_span(text: object) -> str:
    """Quote untrusted text as inline code; only a backtick or a table's bar could end it."""
    return "`" + _one_printable_line(text).replace("`", "'").replace("|", "\\|") + "`"


def yaml_string(text: object) -> str:
    """Quote untrusted text as a YAML string in double quotes."""
    return json.dumps(_one_printable_line(text), ensure_ascii=False)


def _one_printable_line(text: object) -> str:
    """Replace what can't be printed, such as line breaks and lone surrogates, by spaces."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def citation_file(title: str) -> str:
    """Return the CITATION.cff of a dataset."""
    return filled_template(
        "citation.cff",
        title=yaml_string(f"knotgym: {title}"),
        version=json.dumps(knotgym.__version__),
    )


def filled_template(template: str, **parts: object) -> str:
    """Fill a text template of this package with texts, or lists of lines.

    `$to_cite` becomes the section with the BibTeX.
    """
    text = (files("knotgym.datasets.cards") / template).read_text(encoding="utf-8")
    lists = {name: "\n".join(part) for name, part in parts.items() if isinstance(part, list)}
    return Template(text).substitute({**parts, **lists}, to_cite="\n".join(TO_CITE))


def write_text(path: Path, text: str) -> None:
    """Write a text file that ends with a line break."""
    path.write_text(text + ("" if text.endswith("\n") else "\n"), encoding="utf-8")


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


def counted(
    title: str, columns: Mapping[str, NDArray[Any]], values: Mapping[str, tuple[str, object]]
) -> CardTable:
    """Count the rows of each number of crossings, their codes, and values of other columns.

    Args:
        title: of the table.
        columns: nx, gauss_code, gauss_code_chiral and those of `values`, (n,) each.
        values: name of a column of the table -> column and value that are counted.
    """
    rows: list[tuple[object, ...]] = []
    names = {"gauss_code", "gauss_code_chiral", *(column for column, _ in values.values())}
    for nx in np.unique(columns["nx"]).tolist():
        own = {name: columns[name][columns["nx"] == nx] for name in names}
        codes, chiral = Counter(own["gauss_code"].tolist()), {*own["gauss_code_chiral"].tolist()}
        each = f"{min(codes.values())} / {max(codes.values())}"
        found = [int((own[column] == value).sum()) for column, value in values.values()]
        rows.append((nx, codes.total(), len(codes), len(chiral), each, *found))
    return CardTable(
        title,
        ("nx", "rows", "codes", "chiral", "each", *values),
        rows,
        "chiral: codes with chirality; each: fewest / most rows of a code",
    )


def measured(measures: Mapping[str, tuple[str, NDArray[Any]]]) -> CardTable:
    """Return the least, median and largest value of each measure, name -> unit and values (n,)."""
    rows = [
        (name, unit, *(f"{value:.3g}" for value in np.quantile(own, [0, 0.5, 1])))
        for name, (unit, own) in measures.items()
        if len(own)
    ]
    head = ("measure", "unit", "min", "median", "max")
    return CardTable("quality", head, rows, left=head[:2])


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Format a Markdown table; return its lines.

    >>> table(("nx", "states"), [(3, 40)])
    ['| nx | states |', '| --- | --- |', '| 3 | 40 |']
    """
    return [f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *rows)]


def in_words(value: Any) -> str:
    """Format a value of a summary for reading; "" for None, "none" for one in a mapping."""
    if isinstance(value, Mapping):
        entries = [
            f"{name} {in_words(one) or 'none'}" for name, one in list(value.items())[:_LISTED]
        ]
        more = len(value) - len(entries)
        return ", ".join(entries) + (f" and {more} more" if more else "")
    if isinstance(value, list):
        is_interval = bool(value) and isinstance(value[0], float)
        return (" to " if is_interval else " and ").join(map(in_words, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)
