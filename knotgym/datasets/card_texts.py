"""What cards (README.md) are made of: templates, tables of facts, citation, escaped text."""

import html
import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym

TEMPLATES = files("knotgym.datasets") / "card_templates"
TABLES = tomllib.loads((TEMPLATES / "tables.toml").read_text("utf-8"))
BIBTEX = (TEMPLATES / "citation.bib").read_text("utf-8").strip()


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
    name, version = yaml_string(f"knotgym: {title}"), json.dumps(knotgym.__version__)
    return filled_template("citation.cff", title=name, version=version)


def filled_template(template: str, **parts: object) -> str:
    """Fill a text template of this package with texts, or lists of lines."""
    lists = {name: "\n".join(part) for name, part in parts.items() if isinstance(part, list)}
    text = Template((TEMPLATES / template).read_text("utf-8"))
    return text.substitute({**parts, **lists}, bibtex=BIBTEX)


def filled_card(
    template: str, tables: Mapping[str, "CardTable"], config: Mapping[str, Any], **parts: object
) -> str:
    """Fill a template with tables and parts, and with what a run was asked for and made by."""
    markdown = {name.replace(" ", "_"): table._markdown() for name, table in tables.items()}
    versions = {"version": knotgym.__version__, "mujoco": mujoco.__version__}
    asked = {"seed": config["seed"], "config": json.dumps(config, indent=1, sort_keys=True)}
    return filled_template(template, **markdown, **versions, **asked, **parts)


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

    @classmethod
    def of(cls, title: str, rows: Sequence[Sequence[object]], **parts: object) -> "CardTable":
        """Return a table that `tables.toml` describes; `parts` fill its text."""
        described = TABLES[title]
        says = described.get("says", "").format(**parts)
        return cls(title, described["head"], rows, says, described.get("left", ()))

    def _markdown(self) -> str:
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
        same_nx = {name: columns[name][columns["nx"] == nx] for name in names}
        codes = Counter(same_nx["gauss_code"].tolist())
        chiral = {*same_nx["gauss_code_chiral"].tolist()}
        each = f"{min(codes.values())} / {max(codes.values())}"
        counts = [int((same_nx[column] == value).sum()) for column, value in values.values()]
        rows.append((nx, codes.total(), len(codes), len(chiral), each, *counts))
    head = ("nx", "rows", "codes", "chiral", "each", *values)
    return CardTable(title, head, rows, TABLES["counted"]["says"])


def measured(measures: Mapping[str, tuple[str, NDArray[Any]]]) -> CardTable:
    """Return the least, median and largest value of each measure, name -> unit and values (n,)."""
    rows = [
        (name, unit, *(f"{value:.3g}" for value in np.quantile(values, [0, 0.5, 1])))
        for name, (unit, values) in measures.items()
        if len(values)
    ]
    return CardTable.of("quality", rows)


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Format a Markdown table; return its lines.

    >>> table(("nx", "states"), [(3, 40)])
    ['| nx | states |', '| --- | --- |', '| 3 | 40 |']
    """
    return [f"| {' | '.join(map(str, cells))} |" for cells in (head, ["---"] * len(head), *rows)]
