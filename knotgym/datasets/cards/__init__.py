"""Dataset cards (README.md): templates, tables of facts, citation, and escaped text; and those of
folders of states and of pictures.
"""

import html
import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import one_line
from knotgym.datasets.gallery import write_gallery
from knotgym.datasets.image_table import file_stem, marks_base, measures_of, read_table, shards
from knotgym.datasets.manifest import read_manifest, write_manifest
from knotgym.quality import GRADES
from knotgym.rendering import APPEARANCES
from knotgym.states import IMAGE_SPLITS, SOURCES, SPLITS, STATE_SPLITS, Spectra, States, read_states
from knotgym.topology import GaussCode

if TYPE_CHECKING:
    from knotgym.datasets.located import Located

_FOLDER = files("knotgym.datasets.cards")
_TABLES = tomllib.loads((_FOLDER / "tables.toml").read_text("utf-8"))
BIBTEX = (_FOLDER / "citation.bib").read_text("utf-8").strip()
_COUNTED = ("gauss_code", "gauss_code_chiral", "split", "grade", "nx", "accepted")
_SPLITS = {name: ("split", name) for name, one in SPLITS.items() if one.of_states}
_IMAGE_SPLITS = {name: ("split", name) for name in IMAGE_SPLITS}
_GRADES = {name: ("grade", name) for name in GRADES} | {"accepted": ("accepted", True)}

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


def _code_span(text: object) -> str:
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
    text = Template((_FOLDER / template).read_text("utf-8"))
    return text.substitute({**parts, **lists}, bibtex=BIBTEX)


def _filled(
    template: str, tables: Mapping[str, "CardTable"], config: Mapping[str, Any], **parts: object
) -> str:
    """Fill a template with tables and parts, and with what a run was asked for and made by."""
    markdown = {name.replace(" ", "_"): one._markdown() for name, one in tables.items()}
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
    def _of(cls, title: str, rows: Sequence[Sequence[object]], **parts: object) -> "CardTable":
        """Return a table that `tables.toml` describes; `parts` fill its text."""
        described = _TABLES[title]
        says = described.get("says", "").format(**parts)
        return cls(title, described["head"], rows, says, described.get("left", ()))

    def _markdown(self) -> str:
        """Return the explanation of the columns, and the table; "" without rows."""
        if not self.rows:
            return ""
        says = f"{self.says[0].upper()}{self.says[1:]}.\n\n" if self.says else ""
        return says + "\n".join(table(self.head, [map(plain, row) for row in self.rows]))


def _counted(
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
    return CardTable(title, head, rows, _TABLES["counted"]["says"])


def _measured(measures: Mapping[str, tuple[str, NDArray[Any]]]) -> CardTable:
    """Return the least, median and largest value of each measure, name -> unit and values (n,)."""
    rows = [
        (name, unit, *(f"{value:.3g}" for value in np.quantile(own, [0, 0.5, 1])))
        for name, (unit, own) in measures.items()
        if len(own)
    ]
    return CardTable._of("quality", rows)


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Format a Markdown table; return its lines.

    >>> table(("nx", "states"), [(3, 40)])
    ['| nx | states |', '| --- | --- |', '| 3 | 40 |']
    """
    return [f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *rows)]


def in_words(value: Any) -> str:
    """Format a value of a summary for reading; "" for None, "none" for one in a mapping."""
    if isinstance(value, Mapping):
        listed = [*value.items()][:_LISTED]
        entries = [f"{name} {in_words(one) or 'none'}" for name, one in listed]
        more = len(value) - len(entries)
        return ", ".join(entries) + (f" and {more} more" if more else "")
    if isinstance(value, list):
        is_interval = bool(value) and isinstance(value[0], float)
        return (" to " if is_interval else " and ").join(map(in_words, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else one_line(value)  # a stranger's text


def summary(located: "Located") -> tuple[list[str], dict[str, CardTable]]:
    """Return what states or pictures are, in lines, and the tables of facts about them by name."""
    if located.pictures:
        size = sum(shard.stat().st_size for shard in shards(located.pictures))
        count = len(read_table(located.pictures, columns=["nx"]))
        lines = [f"{count} pictures, {size / count:.0f} bytes each"]
        return lines, _image_tables(located.pictures)
    states = read_states(located.states, images=False)
    made = sorted(Counter(states.source.get("policy", np.empty(0, str)).tolist()).items())
    lines = [f"{len(states)} states"]
    lines += [f"sources: {', '.join(f'{policy} {count}' for policy, count in made)}"] * bool(made)
    report = read_manifest(located.folder)[0].get("report", {})
    return lines, _state_tables(states, report)


def _state_tables(states: States, report: Mapping[str, Any]) -> dict[str, CardTable]:
    """Return the tables of facts about states by name.

    `report` is that of the manifest; {} for states without one.
    """
    numbers = sorted(set(states.nx.tolist()))
    existing = report.get("existing_codes", {})
    rejected = [
        (nx, reason, count)
        for nx, reasons in report.get("rejected", {}).items()
        for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    ]
    counted, more, rows = _counted("states", states.table, _SPLITS), _TABLES["states"], []
    for nx, row in zip(numbers, counted.rows, strict=True):
        codes = map(GaussCode.parse, states.gauss_code_chiral[states.nx == nx].tolist())
        signs = Counter(sign for code in codes for sign in code.signs)
        rows.append((*row, existing.get(str(nx), "?") or "many", f"{signs[1]} / {signs[-1]}"))
    head, says = (*counted.head, *more["head"]), f"{counted.says}; {more['says']}"
    listed = (
        CardTable("states", head, rows, says),
        CardTable._of("train and test", [_overlap(states, nx) for nx in numbers]),
        _measured(states.measures),
        CardTable._of("rejected", rejected, attempts=report.get("attempts")),
    )
    return {one.title: one for one in listed}


def finish(
    folder: Path,
    report: Mapping[str, Any],
    request: Mapping[str, Any],
    states: States | None = None,
) -> None:
    """Write card, manifest and what else is about the data into a run's folder that has them.

    That is a gallery for states, and Croissant for pictures.

    Args:
        folder: holds the states and demonstrations, or the Parquet files.
        report: the run's counts: source, existing codes, rejections, demonstrations; or ropes,
            frames, and frames not used, by reason.
        request: what was asked for: configuration, sources, versions.
        states: those in the folder; None for pictures.
    """
    config = request["config"]
    if states is not None:
        write_gallery(folder / "gallery.png", states)
        write_text(folder / "README.md", _state_card(states, report, config))
        return write_manifest(folder, "knotgym-manifest", request, report)
    from knotgym.datasets.cards.croissant import write_croissant

    write_text(folder / "README.md", _image_card(folder, report, config))
    appearance, nx = config["appearance"]["name"], ", ".join(map(str, config["nx"]))
    about = f"Pictures of a closed rope with {nx} crossings and their Gauss codes; made by knotgym."
    write_croissant(folder, f"knotgym-pictures-{appearance}", about, appearance)
    return write_manifest(folder, "knotgym-images-manifest", request, report)


def _state_card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    lacking = ", ".join(_code_span(code or "loop") for code in report.get("undemonstrated", []))
    return _filled(
        "state_card.md",
        _state_tables(states, report),
        config,
        crossings=", ".join(map(str, sorted(set(states.nx.tolist())))),
        count=len(states),
        knot=plain(report["knot"]),
        engine=states.engine,
        source=plain(report["source"]),
        sources="\n".join(
            f"- `{name}`: {SOURCES[name].doc}"
            for name in np.unique(states.source["policy"]).tolist()
        ),
        passed=sum(map(len, report.get("passed_over", {}).values())),
        demonstrations=report.get("demonstrations", 0),
        lacking=lacking and f"The expert reached no goal of these codes: {lacking}.",
        columns=states.table.schema.page(),
    )


def _overlap(states: States, nx: int) -> tuple[object, ...]:
    train, test = (states.rows(nx, split) for split in STATE_SPLITS)
    known, asked = (
        (states.gauss_code[rows].tolist(), states.diagrams(rows)) for rows in (train, test)
    )
    every, near = np.flatnonzero([SPLITS[one].trains for one in states.split]), "-"
    if len(test) and len(every):
        apart, _ = Spectra.of(states.points[test]).nearest(Spectra.of(states.points[every]))
        near = f"{1000 * apart.min():.1f}"
    shared = [sum(one in {*seen} for one in own) for own, seen in zip(asked, known, strict=True)]
    return nx, len(test), *shared, near


def _image_tables(path: Path) -> dict[str, CardTable]:
    """Return the tables of facts about a perception table by name."""
    rows = read_table(path, columns=[*_COUNTED, "quality"])
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}
    counts = [_counted("splits", columns, _IMAGE_SPLITS), _counted("grades", columns, _GRADES)]
    return {one.title: one for one in (*counts, _measured(measures_of(rows)))}


def _image_card(folder: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    name = config["appearance"]["name"]
    rows, files = read_table(folder, columns=["nx", "split", "appearance"]), shards(folder)
    splits = [name for name in IMAGE_SPLITS if name in set(rows["split"].to_pylist())]
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in splits]
    return _filled(
        "image_card.md",
        _image_tables(folder),
        config,
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(map(str, sorted(set(rows["nx"].to_pylist())))),
        pictures=len(rows),
        bytes=f"{sum(file.stat().st_size for file in files) / len(rows):.0f}",
        engine=config["engine"],
        appearance=f"`{name}`, {APPEARANCES[name].says}",
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        held=_TABLES["held"]["marked" if marks_base(rows) else "unmarked"],
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
    )


def suite_card(report: Mapping[str, Any], references: Sequence[Sequence[object]]) -> str:
    """Return the card of the benchmark as Markdown.

    Args:
        report: the content of suite.json.
        references: states and engine, set-up, random, expert and episodes of each score.
    """
    sets = report["sets"]
    columns = "id states split engine policy seed episodes steps starts goals pairs".split()
    head = (*columns, "reached, %", "MB", "as recorded", "digest of values", "as known")
    rows = []
    for name, facts in sorted(sets.items()):
        size, digest = f"{facts['bytes'] / 1e6:.1f}", f"`{facts['values'][:16]}`"
        cells = (plain(facts[key]) for key in columns[1:])
        share = f"{100 * facts['succeeded'] / max(facts['episodes'], 1):.1f}"
        reached = "" if facts["endless"] else share
        made = plain(facts["recorded"]), digest, facts["as known"]
        rows.append((_code_span(name), *cells, reached, size, *made))
    return filled_template(
        "suite_card.md",
        count=len(sets),
        episodes=sum(one["episodes"] for one in sets.values()),
        steps=sum(one["steps"] for one in sets.values()),
        version=report["knotgym"],
        seed=report["seed"],
        sets=table(head, rows),
        references=table(
            ("states and engine", "set-up", "random", "expert", "episodes"), references
        ),
    )
