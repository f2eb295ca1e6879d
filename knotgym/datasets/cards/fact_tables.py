"""Tables of counts: in Markdown on cards, and on the terminal (`cli.summaries`)."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from knotgym.datasets.cards.citation import plain
from knotgym.datasets.image_table import GRADES
from knotgym.states.splits import IMAGE_SPLITS


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
        """Return the explanation of the columns, and the table."""
        says = f"{self.says[0].upper()}{self.says[1:]}.\n\n" if self.says else ""
        return says + "\n".join(table(self.head, [map(plain, row) for row in self.rows]))


def table_row(*cells: object) -> str:
    """Format one row of a Markdown table.

    >>> table_row("nx", 3)
    '| nx | 3 |'
    """
    return "| " + " | ".join(map(str, cells)) + " |"


def table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> list[str]:
    """Format a Markdown table; return its lines."""
    return [table_row(*one) for one in (head, ["---"] * len(head), *rows)]


def state_tables(facts: Mapping[str, Any], report: Mapping[str, Any]) -> dict[str, CardTable]:
    """Return the tables of a state file that have rows, by name.

    `facts` is `state_card.summary`, `report` that of the manifest.
    """
    existing = report.get("existing_codes", {})
    states = [
        (
            nx,
            *(count[name] for name in ("states", "codes")),
            existing.get(nx, "?") or "many",
            *(count[name] for name in ("codes_with_chirality", "train", "test")),
            count["codes_in_both_splits"],
            f"{count['positive_crossings']} / {count['negative_crossings']}",
            " / ".join(map(str, count["actions_to_reach"])),
        )
        for nx, count in facts["nx"].items()
    ]
    quality = [
        (name, one["unit"], *(f"{one[key]:.3g}" for key in ("min", "median", "max")))
        for name, one in facts["quality"].items()
    ]
    rejected = [
        (nx, reason, count)
        for nx, reasons in report.get("rejected", {}).items()
        for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    ]
    tables = {
        "states": CardTable(
            "states",
            ("nx", "states", "codes", "of", "chiral", "train", "test", "both", "c / a", "actions"),
            states,
            "of: existing Gauss codes; chiral: codes with chirality; both: codes in both splits;"
            " c / a: positive and negative crossings; actions: fewest / median / most to reach a"
            " state",
        ),
        "overlap": CardTable(
            "train and test",
            ("nx", "test states", "code in train", "diagram in train", "nearest, mm"),
            overlap_rows(facts["nx"]),
            "code in train: test states whose code (without chirality) some train state has;"
            " diagram in train: test states whose code some train state has up to symmetry (another"
            " base bead, the other direction, mirrored or switched); nearest: the smallest distance"
            " from a test state to a train state of any nx, root mean square over the beads,"
            " minimized over those symmetries and rotations about z",
        ),
        "spread": CardTable(
            "spread",
            ("nx", "apart", "shapes", "gyration", "height", "visits", "bare"),
            spread_rows(facts["nx"]),
            "apart: mm, median / min distance of two states (root mean square over the beads, after"
            " the best rotation about z); shapes: the same, minimized over base bead and direction"
            " too; gyration: mm, min / max radius of gyration; height: mm, min / max from the"
            " lowest to the highest bead; visits: beads, mean distance along the rope between"
            " crossings of two states, 25 for random positions; bare: beads, longest stretch where"
            " no state has a crossing",
        ),
        "quality": CardTable(
            "quality",
            ("measure", "unit", "min", "median", "max"),
            quality,
            left=("measure", "unit"),
        ),
        "rejected": CardTable(
            "rejected",
            ("nx", "reason", "rejected"),
            rejected,
            f"of {report.get('attempts')} drawings or walks, which can have several reasons",
            left=("reason",),
        ),
    }
    return {name: one for name, one in tables.items() if one.rows}


def image_tables(facts: Mapping[str, Any]) -> dict[str, CardTable]:
    """Return the tables of a perception table by name; `facts` is `image_card.summary`."""
    parts = {**{f"nx {nx}": one for nx, one in facts["nx"].items()}, **facts["splits"]}
    whole = ("pictures", "codes", "codes_with_chirality")
    return {
        "counts": CardTable(
            "pictures",
            ("", "pictures", "codes", "chiral", "of a code", "accepted"),
            [
                (
                    name,
                    *(one[key] for key in whole),
                    " / ".join(map(str, one["of_a_code"])),
                    one["accepted"],
                )
                for name, one in parts.items()
            ],
            "chiral: codes with chirality; of a code: fewest / most pictures; accepted: within the"
            " quality limits of generated states",
            left=("",),
        ),
        "grades": CardTable(
            "splits and grades",
            ("", *IMAGE_SPLITS, *GRADES),
            [(name, *one["split"].values(), *one["grade"].values()) for name, one in parts.items()],
            left=("",),
        ),
        "quality": CardTable(
            "quality",
            ("measure", "5 %", "median", "95 %"),
            [
                (name, *(f"{value:.3g}" for value in spread))
                for name, spread in facts["quality"].items()
            ],
            left=("measure",),
        ),
    }


def overlap_rows(counts: Mapping[str, Any]) -> list[list[str]]:
    """Return the overlap of train and test for each nx of a summary."""
    rows = []
    for nx, count in counts.items():
        found = count["overlap"]
        near = "-" if found["nearest"] is None else f"{1000 * found['nearest']:.1f}"
        shared = [str(found[name]) for name in ("test_states", "code_in_train", "diagram_in_train")]
        rows.append([nx, *shared, near])
    return rows


def spread_rows(counts: Mapping[str, Any]) -> list[list[str]]:
    """Return the spread of the states for each nx of a summary."""

    def millimetres(values: Sequence[float] | None) -> str:
        return " / ".join(f"{round(1000 * value, 1):.3g}" for value in values or ()) or "-"

    rows = []
    for nx, count in counts.items():
        found = count["spread"]
        lengths = (millimetres(found[name]) for name in ("distance", "shape", "gyration", "height"))
        beads = (
            "-" if found[name] is None else f"{found[name]:.1f}" for name in ("visits", "bare")
        )
        rows.append([nx, *lengths, *beads])
    return rows
