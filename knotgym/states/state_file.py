"""The state file, `states.h5`: one row per rope state that an environment can reset to.

`schema` lists its columns and attributes.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import knotgym
from knotgym.common import (
    InvalidFile,
    InvalidInput,
    MissingFile,
    Table,
    format_of,
    joined,
    read_tables,
    require_no_links,
    table_digest,
    write_tables,
)
from knotgym.rope import MUJOCO
from knotgym.states.near_duplicates import repeated
from knotgym.states.schema import (
    ATTRIBUTES,
    DIGEST,
    FORMAT,
    STATES,
    VERTICES,
    VERTICES_FORMAT,
    WITHOUT_IMAGES,
)
from knotgym.states.split_names import STATE_SPLITS
from knotgym.topology import UNKNOWN, GaussCode, diagram_form, dt_text, pd_text, same_spot

_ACTIONS = "source/actions"
BY_VERTICES = "vertices"  # attribute `form` of states that were laid from their vertices
_OVERLAP = 0.003  # metres; strands that push against each other in the simulator overlap less


def _column(name: str) -> Any:
    """Return a property that gives a column of the table; None if the table lacks it."""
    return property(lambda states: states.table.get(name))


@dataclass(frozen=True)
class States:
    """The rows of a state file, as read-only arrays: `states.qpos`, `states.quality["margin"]`.

    Attributes:
        table: all columns, by their names in the file, see `schema.STATES`.
        attributes: attributes of the file, see `schema.ATTRIBUTES`.
        digest: checksum of all columns when the file was written; "" if there is none.
        qpos: float64 (n, nq), MuJoCo generalized positions, at rest.
        points: float64 (n, beads, 3), metres.
        image: uint8 (n, size, size, 3); None if read without pictures.
        gauss_code, gauss_code_chiral, pd_code, dt_code, knot, split: str (n,).
        nx: int64 (n,).
    """

    table: Table
    attributes: Mapping[str, Any] = field(default_factory=dict)
    digest: str = ""

    qpos = _column("qpos")
    points = _column("points")
    image = _column("image")
    gauss_code = _column("gauss_code")
    gauss_code_chiral = _column("gauss_code_chiral")
    pd_code = _column("pd_code")
    dt_code = _column("dt_code")
    knot = _column("knot")
    nx = _column("nx")
    split = _column("split")

    @classmethod
    def of(
        cls, columns: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any] | None = None
    ) -> States:
        """Make states of columns by their names in the file.

        If they are missing, `pd_code` and `dt_code` are computed, and rows get no demonstration
        (`source/dataset`, `trajectory`, `step`) and no drawing.
        """
        full = dict(columns)
        if "source/steps" in full:
            steps = full["source/steps"]
            full.setdefault("source/dataset", np.full(len(steps), ""))
            full.setdefault("source/trajectory", np.full(len(steps), -1))
            full.setdefault("source/step", steps)
            full.setdefault("source/drawing", np.full(len(steps), ""))
        for name, text_of in (("pd_code", pd_text), ("dt_code", dt_text)):
            if name not in full:
                codes, rows = np.unique(full["gauss_code_chiral"], return_inverse=True)
                texts = [text_of(GaussCode.parse(code)) for code in codes.tolist()]
                full[name] = np.array(texts, dtype=np.str_)[rows]
        schema = STATES if "image" in full else WITHOUT_IMAGES
        return cls(Table(schema, full), attributes or {})

    @classmethod
    def from_points(cls, points: ArrayLike, split: ArrayLike = "train") -> States:
        """Make states of closed ropes, with all that follows from their points.

        Args:
            points: (n, beads, 3), metres: vertices that an environment or a dataset has; or closed
                curves of as many points, which `Rope.from_curve` turns into configurations.
            split: "train" or "test", for all or for each, (n,).

        Raises:
            InvalidInput: a rope can't lie like this, its knot can't be certified, or there is no
                such split.
        """
        import mujoco  # here, so that reading states needs no simulator

        from knotgym.rope import Rope, rope_of
        from knotgym.states.derivation import derived_row

        curves, splits = np.asarray(points, dtype=np.float64), np.asarray(split, dtype=np.str_)
        if curves.ndim != 3 or curves.shape[2] != 3 or not len(curves):
            raise InvalidInput(f"points must have shape (n, beads, 3), got {curves.shape}")
        if splits.shape not in ((), (len(curves),)) or not np.isin(splits, STATE_SPLITS).all():
            raise InvalidInput(
                f"split must be {' or '.join(STATE_SPLITS)}, one for all or one for each of"
                f" {len(curves)} ropes, got {split!r}"
            )
        if curves.shape[1] and same_spot(curves)[:, -1].all():
            curves = curves[:, :-1]  # the first vertex again, which makes no bead
        rope = Rope(rope_of(curves.shape[1]))
        rows = list[dict[str, Any]]()
        for number, curve in enumerate(curves):
            try:
                qpos = rope.qpos(rope.from_curve(curve, max_overlap=_OVERLAP))
            except InvalidInput as error:
                raise InvalidInput(f"rope {number}: {error}") from None
            laid = rope.points(qpos)
            rows.append({"qpos": qpos, "points": laid, **derived_row(laid)})
            if rows[-1]["knot"] == UNKNOWN:
                raise InvalidInput(f"rope {number}: its knot can't be certified")
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        made_by = {"knotgym": knotgym.__version__, "mujoco": mujoco.__version__}
        return cls.of(
            {**columns, "split": np.broadcast_to(splits, len(rows)).copy()},
            {**made_by, "rope": rope.config.fingerprint, "config": {"made": "from points"}},
        )

    def __post_init__(self) -> None:
        for values in self.table.values():
            values.setflags(write=False)

    def __len__(self) -> int:
        return self.table.rows

    @property
    def quality(self) -> dict[str, NDArray[np.float64]]:
        """Quality measures, name -> float64 (n,); `quality.limits.UNITS` has their units."""
        return self._group("quality/")

    @property
    def source(self) -> dict[str, NDArray[Any]]:
        """Provenance, name -> (n, ...)."""
        return self._group("source/")

    def _group(self, prefix: str) -> dict[str, NDArray[Any]]:
        return {n.removeprefix(prefix): self.table[n] for n in self.table if n.startswith(prefix)}

    @property
    def engine(self) -> str:
        """The engine that the provenance is replayed with, see `knotgym.rope.engines`."""
        return str(self.attributes.get("engine", MUJOCO))

    def rows(self, nx: int, split: str) -> NDArray[np.int64]:
        """Return the indices of the rows with nx crossings in a split.

        "train-code" has the rows of "train" whose diagram isn't held out, "test-code" those of
        "test" whose diagram is. Held out are the diagrams that occur in test only and then those
        that are rarest in train, up to a quarter of the diagrams of the nx; train keeps at least
        one diagram. Loops and curls have a single diagram each and are in both.
        """
        base, by_code, _ = split.partition("-code")
        rows = np.flatnonzero((self.nx == nx) & (self.split == base))
        if not by_code or nx < 2:
            return rows
        train, test = (
            [diagram_form(GaussCode.parse(code)) for code in self.gauss_code[own].tolist()]
            for own in (self.rows(nx, "train"), self.rows(nx, "test"))
        )
        # diagrams of test in the order in which they are held out: absent from train first
        seen = Counter(train)
        rarest = sorted({*test}, key=lambda form: (seen[form], form.visits))
        wanted = math.ceil(len({*train, *test}) / 4)
        held = {
            form
            for rank, form in enumerate(rarest)
            if form not in train or (rank < wanted and {*train} - {*rarest[: rank + 1]})
        }
        own = train if base == "train" else test
        return rows[[(form in held) == (base == "test") for form in own]]

    def taken(self, rows: ArrayLike | slice) -> States:
        """Select rows, by a mask or by indices, in the order given."""
        return States(self.table.take(rows), self.attributes)

    def replaced(self, columns: Mapping[str, NDArray[Any]], **attributes: Any) -> States:
        """Return the states with other values in some columns, by name, and attributes."""
        return States(self.table.replaced(**columns), {**self.attributes, **attributes})


SHIPPED = {  # name -> file
    "readable": "states.h5",
    "random-walk": "random-walk.h5",
    "hard-unknots": "hard-unknots.h5",
    "bench": "bench.h5",
}


def shipped(name: str = "readable") -> Path:
    """Return the path of a set of states that ships with the package.

    Args:
        name: "readable", curated so that the code can be read off the picture, or "random-walk", as
            random play reaches them without over-twisted ones, each with 17 loops and 40 states for
            each nx from 1 to 4; or "hard-unknots", unknots with 7, 10 and 11 crossings, of which
            those with 10 and 11 have neither kinks nor bigons; or "bench", 256 train and 256 test
            states of each nx from 0 to 5, legible as the readable ones, of ropes that the splits
            don't share.

    Raises:
        InvalidFile: there is no set of that name.
    """
    if name not in SHIPPED:
        raise InvalidFile(f"no shipped set of states {name!r}; there are {', '.join(SHIPPED)}")
    return Path(str(files("knotgym.states") / "curated" / SHIPPED[name]))


def ships(named: str | None) -> bool:
    """Whether a task's `states` names a shipped set; None means "readable"."""
    return named is None or named in SHIPPED


def minari_root() -> Path:
    """Return the root folder of Minari datasets: MINARI_DATASETS_PATH, else Minari's default."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def states_file(named: str | None) -> Path:
    """Resolve a task's `states` to a file.

    Args:
        named: the name of a shipped set (None for "readable"), the id of a Minari dataset that
            includes a state file, or the path of a state file or of the folder with `states.h5`.
    """
    if named is None or named in SHIPPED:
        return shipped(named or "readable")
    carried = minari_root() / named / "data" / "states.h5"
    is_id = not leads_out(named) and carried.is_file()
    return carried if is_id and not Path(named).is_file() else states_at(Path(named))


def root_of(named: str | os.PathLike[str]) -> Path:
    """Return the file or folder that a path, the name of an included set or a Minari id names.

    Raises:
        MissingFile: there is no such file, folder or id.
    """
    if Path(named).exists():
        return Path(named)
    if named in SHIPPED:
        return shipped(str(named))
    if not leads_out(named) and (minari_root() / named).is_dir():
        return minari_root() / named
    raise MissingFile(
        f"no such file: {named}, nor a Minari dataset of this id under {minari_root()},"
        f" nor an included set ({', '.join(SHIPPED)})"
    )


def states_at(path: Path) -> Path:
    """Return a path itself, or `states.h5` in it if it is a folder.

    Raises:
        InvalidFile: the folder's file is a link, which could lead to a private file of the user.
    """
    if not path.is_dir():
        return path
    require_no_links(path, [path / "states.h5"])
    return path / "states.h5"


def leads_out(named: str | os.PathLike[str]) -> bool:
    """Whether a path is absolute or contains "..", and so may lead out of a folder."""
    return Path(named).is_absolute() or ".." in Path(named).parts


def demonstrations_id(nx: int, split: str = "train", knot: str = "0_1") -> str:
    """Return the id of the Minari dataset that demonstrates the states of an nx, split and knot.

    Demonstrations of loops (nx 0) are episodes of an unknot task, because nothing is tied.

    >>> demonstrations_id(3)
    'knotgym/tie-nx3/demonstrations-v0'
    >>> demonstrations_id(0, "test")
    'knotgym/unknot-nx0/demonstrations-test-v0'
    >>> demonstrations_id(3, knot="3_1")
    'knotgym/tie-nx3-3_1/demonstrations-v0'
    """
    name = "demonstrations" if split == "train" else f"demonstrations-{split}"
    knotted = "" if knot == "0_1" else f"-{knot}"
    return f"knotgym/{'tie' if nx else 'unknot'}-nx{nx}{knotted}/{name}-v0"


def write_states(path: str | os.PathLike[str], states: States) -> None:
    """Write a state file atomically."""
    if states.image is None:
        raise InvalidInput("a state file needs images, but these states were read without")
    attributes = {**states.attributes, DIGEST: table_digest(states.table)}
    write_tables(path, [states.table], attributes, format=FORMAT, pack=True)


def read_states(path: str | os.PathLike[str], *, images: bool = True) -> States:
    """Read a state file.

    Args:
        path: path of the file.
        images: whether to read the pictures, which are most of the bytes.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: the file is foreign, truncated or of an unknown format version.
    """
    if format_of(path) == VERTICES_FORMAT:
        (table,), attributes = read_tables(path, VERTICES, format=VERTICES_FORMAT)
        return _laid(table, attributes, images=images)
    (table,), attributes = read_tables(path, STATES if images else WITHOUT_IMAGES, format=FORMAT)
    attributes.pop("form", None)  # the reader's word for a file by vertices, not a file's own
    for name in (*ATTRIBUTES, DIGEST):
        kinds = (dict, list) if name == "config" else str
        if name in attributes and not isinstance(attributes[name], kinds):
            raise InvalidFile(f"{path}: attribute {name} is {attributes[name]!r}")
    return States(table, attributes, attributes.pop(DIGEST, ""))


def write_vertices(path: str | os.PathLike[str], table: Table, **attributes: Any) -> None:
    """Write a state file by vertices atomically; `table` fits `schema.VERTICES`."""
    from knotgym.rope import rope_of

    whole = {"rope": rope_of(table["points"].shape[1]).fingerprint, **attributes}
    write_tables(path, [table], whole, format=VERTICES_FORMAT, pack=True)


def _laid(table: Table, attributes: Mapping[str, Any], *, images: bool) -> States:
    """Compute all columns of states from their vertices.

    Laying a rope needs + - * / and square roots alone, so that every processor computes the same.
    """
    # imported here, because only this form needs the simulator
    from knotgym.rope import Rope, rope_of

    rope = Rope(rope_of(table["points"].shape[1]))
    try:
        codes = [GaussCode.parse(text) for text in table["gauss_code_chiral"].tolist()]
        qpos = rope.qpos(table["points"].astype(np.float64))
    except ValueError as error:
        raise InvalidFile(f"a state can't be laid from its vertices: {error}") from error
    count, points = table.rows, rope.points(qpos)
    columns = {name: values for name, values in table.items()} | {
        "qpos": qpos,
        "points": points,
        "gauss_code": np.array([str(code) for code in codes], dtype=np.str_),
        "nx": np.array([code.nx for code in codes], dtype=np.int64),
        "source/start_qpos": qpos,
        "source/actions": np.zeros((count, 0, 6), dtype=np.float32),
        "source/steps": np.zeros(count, dtype=np.int64),
        "source/seed": table["source/trajectory"][:, None] * np.array([1, 0, 0, 0, 0]),
    }
    if images:
        from knotgym.rendering import draw

        columns["image"] = np.stack([draw(one) for one in points])
    return States.of(columns, {**attributes, "form": BY_VERTICES})


def merge_states(parts: Sequence[States], *, distinct: bool = False) -> States:
    """Merge the rows of several state files, stably sorted by nx.

    Args:
        parts: states of the same rope and engine with the same columns.
        distinct: refuse states that are equal bit for bit.

    Raises:
        InvalidFile: the parts can't be combined, or states are equal although `distinct` is set.
    """
    if not parts:
        raise InvalidFile("nothing to merge: give at least one state file")
    _require_equal("rope model", [str(part.attributes.get("rope")) for part in parts])
    _require_equal("engine", [part.engine for part in parts])
    _require_equal("quality and source", [", ".join(sorted(part.table)) for part in parts])
    longest = max(part.table[_ACTIONS].shape[1] if _ACTIONS in part.table else 0 for part in parts)
    order = np.argsort(np.concatenate([part.nx for part in parts]), kind="stable")
    merged = joined([_padded(part.table, longest) for part in parts]).take(order)
    twice = repeated(one.tobytes() for one in merged["points"]) if distinct else []
    if twice:
        raise InvalidFile(
            f"{len(twice)} states occur twice, first in rows {twice[0][0]} and {twice[0][1]} of the"
            " merged file; merge sets that share no state"
        )
    configs = [config for part in parts for config in _configs(part)]
    config = configs if len(configs) > 1 else configs[0]
    return States(merged, {**parts[0].attributes, "config": config})


def _require_equal(what: str, found: Sequence[str]) -> None:
    """Refuse to merge states that differ in something."""
    others = [one for one in found if one != found[0]]
    if others:
        raise InvalidFile(f"states to merge must have one {what}, got {found[0]} and {others[0]}")


def _padded(table: Table, longest: int) -> Table:
    """Pad the actions with zeros."""
    if _ACTIONS not in table:
        return table
    actions = table[_ACTIONS]
    padded = np.pad(actions, ((0, 0), (0, longest - actions.shape[1]), (0, 0)))
    return Table(table.schema._replace(sizes=()), {**table, _ACTIONS: padded})


def _configs(part: States) -> list[Any]:
    config = part.attributes.get("config", {})
    return config if isinstance(config, list) else [config]
