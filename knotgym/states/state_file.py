"""The state file, `states.h5`: one row per rope state that an environment can reset to.

`schema` lists its columns and attributes.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import knotgym
from knotgym.common import InvalidFile, InvalidInput, Table, format_of, read_tables, write_tables
from knotgym.rope import MUJOCO
from knotgym.states.near_duplicates import repeated
from knotgym.states.schema import ATTRIBUTES, FORMAT, STATES, VERTICES, VERTICES_FORMAT, RopeAtRest
from knotgym.states.sources import SPLITS, STATE_SPLITS, resolve_states
from knotgym.topology import UNKNOWN, GaussCode, Symmetry, canonical, same_spot

DIGEST = "content_sha256"  # attribute: `Table.digest` of the file's table
_BY_VERTICES = "vertices"  # attribute `form` of states that were laid from their vertices
_OF_EPISODES = ("dataset", "trajectory", "drawing")  # of `source`; most rows have none of them
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

    qpos, points, image, nx, split = map(_column, ("qpos", "points", "image", "nx", "split"))
    gauss_code, gauss_code_chiral = map(_column, ("gauss_code", "gauss_code_chiral"))
    pd_code, dt_code, knot = map(_column, ("pd_code", "dt_code", "knot"))

    @classmethod
    def of(
        cls, columns: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any] | None = None
    ) -> States:
        """Make states of columns by their names in the file.

        Required columns that are missing are computed from the points, but for the pictures; rows
        with a provenance get the columns that say there is no demonstration and no drawing.
        """
        wanted = STATES if "image" in columns else STATES.without("image")
        missing = [c.name for c in wanted.columns if not c.optional and c.name not in columns]
        table = Table(wanted, {**columns, **_derived(columns, missing)})
        if "source/steps" in table:
            step = {"source/step": table.get("source/step", table["source/steps"])}
            names = *table, *step, *(f"source/{name}" for name in _OF_EPISODES)
            table = Table(wanted, {**table, **step}).filled(wanted.only(*names))
        return cls(table, attributes or {})

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

        from knotgym.rope import Rope, RopeConfig

        curves, splits = np.asarray(points, dtype=np.float64), np.asarray(split, dtype=np.str_)
        if curves.ndim != 3 or curves.shape[2] != 3 or not len(curves):
            raise InvalidInput(f"points must have shape (n, beads, 3), got {curves.shape}")
        known = [name for name, record in SPLITS.items() if record.of_states]
        if splits.shape not in ((), (len(curves),)) or not np.isin(splits, known).all():
            raise InvalidInput(
                f"split must be {' or '.join(known)}, one for all or one for each of"
                f" {len(curves)} ropes, got {split!r}"
            )
        if curves.shape[1] and same_spot(curves)[:, -1].all():
            curves = curves[:, :-1]  # the first vertex again, which makes no bead
        rope, laid = Rope(RopeConfig.of(curves.shape[1])), list[NDArray[np.float64]]()
        for number, curve in enumerate(curves):
            with InvalidInput.instead(f"rope {number}", InvalidInput):
                laid.append(rope.qpos(rope.from_curve(curve, max_overlap=_OVERLAP)))
        columns = {"qpos": np.array(laid), "points": rope.points(np.array(laid))}
        columns |= _derived(columns, [c.name for c in STATES.columns])
        for number in np.flatnonzero(columns["knot"] == UNKNOWN).tolist():
            raise InvalidInput(f"rope {number}: its knot can't be certified")
        made_by = {"knotgym": knotgym.__version__, "mujoco": mujoco.__version__}
        return cls.of(
            {**columns, "split": np.broadcast_to(splits, len(laid)).copy()},
            {**made_by, "rope": rope.config.fingerprint, "config": {"made": "from points"}},
        )

    @staticmethod
    def write_vertices(
        path: str | os.PathLike[str], columns: Mapping[str, NDArray[Any]], **attributes: Any
    ) -> None:
        """Write a state file by vertices atomically, from the columns of `schema.VERTICES`."""
        from knotgym.rope import RopeConfig  # here, as above

        table = Table(VERTICES, columns)
        whole = {"rope": RopeConfig.of(table["points"].shape[1]).fingerprint, **attributes}
        write_tables(path, [table], whole, format=VERTICES_FORMAT, pack=True)

    def __post_init__(self) -> None:
        for values in self.table.values():
            values.setflags(write=False)

    def __len__(self) -> int:
        return self.table.rows

    @property
    def quality(self) -> dict[str, NDArray[np.float64]]:
        """Quality measures, name -> float64 (n,); `measures` has their units."""
        return self._group("quality/")

    @property
    def measures(self) -> dict[str, tuple[str, NDArray[np.float64]]]:
        """Unit and values, float64 (n,), of the quality and of what else describes the ropes."""
        return {
            c.name.removeprefix("quality/"): (c.unit, self.table[c.name])
            for c in self.table.schema.columns
            if (c.dtype, c.shape) == ("float64", ()) and not c.name.startswith("source/")
        }

    @property
    def source(self) -> dict[str, NDArray[Any]]:
        """Provenance, name -> (n, ...)."""
        return self._group("source/")

    def _group(self, prefix: str) -> dict[str, NDArray[Any]]:
        return {n.removeprefix(prefix): self.table[n] for n in self.table if n.startswith(prefix)}

    @property
    def by_vertices(self) -> bool:
        """Whether the file holds vertices alone, so that there are no measures and no replays."""
        return self.attributes.get("form") == _BY_VERTICES

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
        record = SPLITS[split]
        rows = np.flatnonzero((self.nx == nx) & (self.split == record.base))
        if not record.by_code or nx < 2:
            return rows
        train, test = (self.diagrams(self.rows(nx, split)) for split in STATE_SPLITS)
        # diagrams of test in the order in which they are held out: absent from train first
        seen = Counter(train)
        rarest = sorted({*test}, key=lambda form: (seen[form], form.visits))
        wanted = math.ceil(len({*train, *test}) / 4)
        held = {
            form
            for rank, form in enumerate(rarest)
            if form not in train or (rank < wanted and {*train} - {*rarest[: rank + 1]})
        }
        here = train if record.trains else test
        return rows[[(form in held) != record.trains for form in here]]

    def diagrams(self, rows: NDArray[np.int64]) -> list[GaussCode]:
        """Return the codes of rows up to symmetry, see `topology.canonical`."""
        codes = map(GaussCode.parse, self.gauss_code[rows].tolist())
        return [canonical(code, Symmetry.DIAGRAM) for code in codes]

    def take(self, rows: ArrayLike | slice) -> States:
        """Select rows, by a mask or by indices, in the order given."""
        return States(self.table.take(rows), self.attributes)

    def replaced(self, columns: Mapping[str, NDArray[Any]], **attributes: Any) -> States:
        """Return the states with other values in some columns, by name, and attributes."""
        return States(self.table.replaced(**columns), {**self.attributes, **attributes})


def write_states(path: str | os.PathLike[str], states: States) -> None:
    """Write a state file atomically."""
    if states.image is None:
        raise InvalidInput("a state file needs images, but these states were read without")
    attributes = {**states.attributes, DIGEST: Table.digest(states.table)}
    write_tables(path, [states.table], attributes, format=FORMAT, pack=True)


def read_states(path: str | os.PathLike[str] | None = None, *, images: bool = True) -> States:
    """Read a state file.

    Args:
        path: what `resolve_states` takes: the path of a file or of a run's folder, the name of an
            included set, such as "bench", or the id of a Minari dataset; None for "readable".
        images: whether to read the pictures, which are most of the bytes.

    Raises:
        MissingFile: there is no such file, set or dataset.
        InvalidFile: the file is foreign, truncated or of an unknown format version.
    """
    path, wanted = resolve_states(path), STATES if images else STATES.without("image")
    if format_of(path) == VERTICES_FORMAT:
        (table,), attributes = read_tables(path, VERTICES, format=VERTICES_FORMAT)
        return _laid(table, attributes, images=images)
    (table,), attributes = read_tables(path, wanted, format=FORMAT)
    attributes.pop("form", None)  # the reader's word for a file by vertices, not a file's own
    for name in (*ATTRIBUTES, DIGEST):
        kinds = (dict, list) if name == "config" else str
        if name in attributes and not isinstance(attributes[name], kinds):
            raise InvalidFile(f"{path}: attribute {name} is {attributes[name]!r}")
    return States(table, attributes, attributes.pop(DIGEST, ""))


def _laid(table: Table, attributes: Mapping[str, Any], *, images: bool) -> States:
    """Compute all columns of states from their vertices.

    Laying a rope needs + - * / and square roots alone, so that every processor computes the same.
    """
    # imported here, because only this form needs the simulator
    from knotgym.rope import Rope, RopeConfig

    rope = Rope(RopeConfig.of(table["points"].shape[1]))
    with InvalidFile.instead("a state can't be laid from its vertices", ValueError):
        qpos = rope.qpos(table["points"].astype(np.float64))
        points, count = rope.points(qpos), table.rows
        columns = {
            **table,
            "qpos": qpos,
            "points": points,
            "source/start_qpos": qpos,
            "source/actions": np.zeros((count, 0, 6), dtype=np.float32),
            "source/steps": np.zeros(count, dtype=np.int64),
            "source/seed": table["source/trajectory"][:, None] * np.array([1, 0, 0, 0, 0]),
        }
        more = _derived(columns, ["image"]) if images else {}
        return States.of({**columns, **more}, {**attributes, "form": _BY_VERTICES})


def _derived(columns: Mapping[str, NDArray[Any]], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Compute columns of rows that have points, and perhaps a code with chirality."""
    wanted = [c for c in STATES.columns if c.name in names and c.derived]
    if not wanted:
        return {}
    texts = columns.get("gauss_code_chiral", np.full(len(columns["points"]), None)).tolist()
    codes = [None if text is None else GaussCode.parse(text) for text in texts]
    ropes = [RopeAtRest(p, code=code) for p, code in zip(columns["points"], codes, strict=True)]
    return {c.name: np.array([*map(c.derived, ropes)], c.numpy) for c in wanted if c.derived}


def merge_states(parts: Sequence[States], *, distinct: bool = False) -> States:
    """Merge the rows of several state files, stably sorted by nx.

    Args:
        parts: states of the same rope and engine. What some lack is computed if it follows from
            the points, and unknown ("", -1, NaN) otherwise, but for what led to a state.
        distinct: refuse states that are equal bit for bit.

    Raises:
        InvalidFile: the parts can't be combined, or states are equal although `distinct` is set.
    """
    if not parts:
        raise InvalidFile("nothing to merge: give at least one state file")
    ropes = dict.fromkeys(str(part.attributes.get("rope")) for part in parts)
    engines = dict.fromkeys(part.engine for part in parts)
    for what, kinds in (("rope model", ropes), ("engine", engines)):
        if len(kinds) > 1:
            given = " and ".join(kinds)
            raise InvalidFile(f"states to merge must have one {what}, got {given}")
    schema = STATES.only(*{name for part in parts for name in part.table})
    tables = list[Table]()
    for number, part in enumerate(parts, 1):
        missing = [c.name for c in schema.columns if c.name not in part.table]
        columns = {**part.table, **_derived(part.table, missing)}
        said = f"state file {number} can't be merged with the others"
        with InvalidFile.instead(said, InvalidInput):
            tables.append(Table(schema, columns).filled(schema))
    order = np.argsort(np.concatenate([part.nx for part in parts]), kind="stable")
    merged = Table.joined(tables).take(order)
    twice = repeated(points.tobytes() for points in merged["points"]) if distinct else []
    for first, second in twice:
        rows = f"rows {first} and {second}"
        raise InvalidFile(f"{len(twice)} states occur twice, first in {rows} of the merged file")
    configs = list[Any]()
    for part in parts:
        config = part.attributes.get("config", {})
        configs += config if isinstance(config, list) else [config]
    config = configs if len(configs) > 1 else configs[0]
    return States(merged, {**parts[0].attributes, "config": config})
