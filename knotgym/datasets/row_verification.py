"""Verify rows: states and pictures, the folders that hold them, and all that a path or an id names.

Verification believes nothing that is stored: it compares every row with what follows from its
points, replays what led to a state, draws a picture again from its appearance, and looks for what
splits share. Each fault is reported as one line.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import (
    Array,
    Counts,
    InvalidFile,
    InvalidInput,
    KnotgymError,
    MissingFile,
    Stream,
    Table,
    from_json,
    one_line,
)
from knotgym.datasets import image_table
from knotgym.datasets.episode_dataset import FILE, EpisodeDataset, open_episodes
from knotgym.datasets.episode_verification import Replay, ReplayFault, episode_faults, shared_faults
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.located import Located
from knotgym.datasets.manifest import listed_faults, read_manifest
from knotgym.datasets.png import decode
from knotgym.drawing import DrawingConfig, drawn_curve
from knotgym.envs import TaskConfig
from knotgym.quality import Limits, Quality
from knotgym.rendering import APPEARANCES, AppearanceConfig, Drawer
from knotgym.rope import ENGINES, Rope, RopeConfig, drawn_actions, simulation
from knotgym.states import (
    IMAGE_SPLITS,
    SOURCES,
    SPLITS,
    STATES,
    RopeAtRest,
    States,
    held_form,
    read_states,
    repeated,
)
from knotgym.topology import GaussCode, pyknotid_code

# in your own files quality and source may be missing, but then rows can't be verified
_NEEDED = {c.name for c in STATES.columns if not c.optional or "/" in c.name} - {"image"}
_BATCH = 64  # rows replayed in one simulation
# tolerance of a measure, relative to 1 + its modulus: other processors round differently
_ROUNDING = 1e-9
# metres; tolerance for a start that is drawn again from its seed: other processors round
# differently and the relaxation amplifies that. Replays from the stored start must be exact.
_REDRAWN = 1e-4
_LONGEST = 100_000  # actions of a random walk; a corrupted larger number would exhaust the memory
_COLOURS = ("published", "single", "gradient")
# what foreign numbers make the renderer and NumPy raise
_RAISED = (KnotgymError, ValueError, TypeError, ArithmeticError, LookupError, cv2.error)
_SHARED = ("gauss_code", "nx", "split", "points", "source", "appearance")  # compared by splits
_MOST_DRAWN = 1000.0  # of numbers that a picture is drawn with; larger ones would fill the memory
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # `map`, or that of a pool


def _state_faults(states: States) -> Iterator[str]:
    """Yield the faults of the rows: schema, codes, measures, pictures, replays, splits, digest."""
    made_for, beads = states.attributes.get("rope"), states.points.shape[1]
    if beads not in TaskConfig.BEADS or RopeConfig.of(beads).fingerprint != made_for:
        yield f"rope model {made_for} is not this version's, {RopeConfig().fingerprint}"
        return
    if states.engine not in ENGINES:
        yield f"states.h5: engine must be one of {', '.join(ENGINES)}, got {states.engine!r}"
        return
    rope, unneeded = Rope(RopeConfig.of(beads)), list[str]()  # how names of columns begin
    # states by vertices have no measures, and files of earlier versions lack new ones
    if states.by_vertices or states.quality:
        unneeded.append("quality/")
    sources = {SOURCES.get(name) for name in states.source.get("policy", ())}
    if all(source is not None and source.draws_actions for source in sources):
        unneeded.append("source/actions")
    if not states.source:  # nobody simulated them, see `States.from_points`
        unneeded.append("source/")
    lacking = [
        name for name in sorted(_NEEDED - {*states.table}) if not name.startswith((*unneeded,))
    ]
    yield from (f"states.h5: {name} is missing" for name in lacking)
    if states.qpos.shape[1] != rope.nq:
        yield f"states.h5: qpos has {states.qpos.shape[1]} numbers a row, should have {rope.nq}"
        return
    replays = states.source and not any(name.startswith("source/") for name in lacking)
    for first in range(0, len(states), _BATCH):
        rows = range(first, min(first + _BATCH, len(states)))
        ends = _replayed(states, rows, rope) if replays else None
        for row in rows:
            # replays count as half of the work
            Counts.tell("states checked", (row + rows.stop) / 2, len(states))
            for fault in _row_faults(states, row, rope, ends):
                yield type(fault)(f"states.h5 row {row}: {fault}")
    # without seeds each row may be of a rope of its own
    seeds = states.source.get("seed", np.arange(len(states))[:, None])
    ropes = list(map(tuple, seeds.tolist()))
    for fault in shared_faults(states.points, states.split, ropes, range(len(states))):
        yield f"states.h5 {fault}"
    for first, row in repeated(points.tobytes() for points in states.points):
        yield f"states.h5 rows {first} and {row} are the same configuration"
    if states.digest and states.image is not None and states.digest != Table.digest(states.table):
        yield "states.h5: its columns don't match content_sha256"


def _manifest_faults(folder: Path) -> Iterator[str]:
    """Yield the faults of a folder's manifest, and files that aren't what it lists."""
    manifest, faults = read_manifest(folder)
    yield from (*faults, *listed_faults(folder, manifest))


def _folder_faults(folder: Path, replay: Replay, sample: int = 0) -> Iterator[str]:
    """Yield the faults of a folder that `knotgym generate` wrote.

    Manifest and checksums come first, then the rows, the demonstrations and the splits.
    """
    try:
        states = read_states(folder / "states.h5")
    except (InvalidFile, MissingFile) as error:
        yield from (*_manifest_faults(folder), str(error))
        return
    if states.source or (folder / "manifest.json").exists():
        yield from _manifest_faults(folder)
    yield from _state_faults(states)
    for file in sorted(folder.glob(f"minari/**/{FILE}")):
        faults_here = [*episode_faults(file, replay, sample=sample)]
        yield from faults_here
        if not faults_here:
            name = file.relative_to(folder / "minari").parents[1].as_posix()
            yield from _demonstration_faults(states, name, open_episodes(file))


def _demonstration_faults(states: States, name: str, played: EpisodeDataset) -> Iterator[str]:
    """Yield the rows that name an episode of the dataset `name` that doesn't lead to them.

    The episode must end in the row's code, with the row as its goal.
    """
    source = states.source
    if not {"dataset", "trajectory", "step"} <= source.keys():
        return
    (rows, steps), first = played.episodes, played.episodes.offsets
    for row in np.flatnonzero(source["dataset"] == name).tolist():
        k, step = int(source["trajectory"][row]), int(source["step"][row])
        if not 0 <= k < rows.rows or not 0 <= step <= rows["length"][k]:
            fault = f"has no state {step}"
        elif gauss_codes(steps["visits"][[first[k] + step]])[0] != states.gauss_code[row]:
            fault = f"doesn't lead to its code: its state {step} shows another"
        elif not np.array_equal(rows["goal_points"][k], states.points[row].astype(np.float32)):
            fault = "has another goal"
        elif played.task.split != states.split[row]:
            fault = f"is of the {played.task.split} split, the row of the other"
        else:
            continue
        yield f"states.h5 row {row}: episode {k} of {name} {fault}"


def _derived_faults(
    stored: Mapping[str, Any],
    rope: Rope,
    derive: Callable[[RopeAtRest], Mapping[str, Any]] = STATES.derive,
) -> Iterator[str]:
    """Yield how a row differs from what follows from its points, and from the second labeller.

    Args:
        stored: values by column name, `points` among them; columns that are missing aren't checked.
        rope: the rope; what is wider than it is long can't be measured.
        derive: computes the columns that follow from how a rope lies.
    """
    shown = RopeAtRest(stored["points"])
    across = float(np.ptp(shown.points, axis=0).max())
    if not across <= rope.config.length:
        yield f"points are {across:.3g} m apart, the rope is {rope.config.length:g} m long"
        return
    for name, right in derive(shown).items():
        yield from _unlike(name, stored.get(name, right), right)
    second = pyknotid_code(shown.points)
    if second != shown.code:
        yield f"pyknotid reads {second.chiral}, our labeller reads {shown.code.chiral}"


def _unlike(name: str, stored: Any, right: Any) -> Iterator[str]:
    """Yield how a value differs from the right one; numbers may differ by rounding."""
    if isinstance(right, dict):
        for inner, part in right.items():
            yield from _unlike(f"{name}.{inner}", stored.get(inner, part), part)
    elif isinstance(right, (bytes, np.ndarray)):
        # the same picture may be compressed in other ways
        read: Any = decode if isinstance(right, bytes) else np.asarray
        if not np.array_equal(read(stored), read(right)):
            yield f"{name} is not the picture of points"
    elif stored != right:
        near = {"rel_tol": _ROUNDING, "abs_tol": _ROUNDING}  # nothing is near infinity
        if not (isinstance(right, float) and math.isclose(stored, right, **near)):
            yield f"{name} is {stored}, recomputed {right}"


def _row_faults(
    states: States, row: int, rope: Rope, ends: Mapping[int, Array] | None
) -> Iterator[str]:
    """Yield the faults of one row.

    Args:
        states: the table.
        row: which.
        rope: the rope.
        ends: qpos at the end of each replay, by row, of those that didn't fail; None if the table
            doesn't say what led to its rows.
    """
    stored = {name: values[row] for name, values in states.table.items()}
    off = np.abs(rope.points(stored["qpos"]) - stored["points"]).max()
    if not off <= ENGINES[states.engine].rounding:
        yield "points are not those of qpos"
    yield from _derived_faults(stored, rope)
    if (split := str(stored["split"])) not in SPLITS or not SPLITS[split].of_states:
        yield f"split is {split!r}"
    if ends is None:
        return
    end = ends.get(row)
    try:
        _actions_of(states, row)
        source, seed = SOURCES[str(stored["source/policy"])], stored["source/seed"]
        if source.stream is not None:
            seed = _key(seed, source.stream)
        if source.draws_actions and not stored["source/dataset"]:
            walk = seed[2], stored["source/steps"]
            if walk != (stored["source/trajectory"], stored["source/step"]):
                yield f"it isn't step {walk[1]} of rope {walk[0]}, as its seed says"
    except InvalidInput as error:
        yield str(error)
    else:
        if end is None or not np.array_equal(end, stored["qpos"]):
            yield ReplayFault("replay of its start and actions does not end in qpos bit for bit")
    if stored["source/drawing"]:
        yield from _drawing_faults(stored, rope)


def _drawing_faults(stored: Mapping[str, Any], rope: Rope) -> Iterator[str]:
    """Draw the start of a row again and compare."""
    try:
        drawing = json.loads(stored["source/drawing"])
        drawing.pop("easing", None)  # constants, which the included hard unknots name
        config = from_json(DrawingConfig, drawing)
        rng = Stream.generator_of(_key(stored["source/seed"], Stream.DRAWING))
        again = drawn_curve(GaussCode.parse(stored["gauss_code_chiral"]), rng, rope, config)
    except (KnotgymError, ValueError, IndexError, TypeError, AttributeError) as error:
        yield f"its drawing can't be reproduced: {one_line(error)}"
        return
    off = np.abs(again - rope.points(stored["source/start_qpos"])).max()
    if not off <= _REDRAWN:
        yield f"its start differs from the drawing of its seed by {1000 * off:.1f} mm"


def _key(seed: NDArray[np.int64], stream: Stream) -> tuple[int, ...]:
    """Return a row's seed as the key of a stream; raise InvalidInput if it isn't one."""
    numbers = tuple(seed.tolist())
    if numbers != (int(stream), *numbers[1:]) or min(numbers) < 0:
        raise InvalidInput(f"seed {numbers} is not a key of the stream {stream.name}")
    return numbers


def _actions_of(states: States, row: int) -> NDArray[np.float32]:
    """Return the actions that lead from a row's start to its state, float32 (steps, 6)."""
    steps = int(states.source["steps"][row])
    if "actions" in states.source:
        actions: NDArray[np.float32] = states.source["actions"][row, :steps]
        if not (np.abs(actions) <= 1).all():
            raise InvalidInput("an action lies outside [-1, 1]")
        return actions
    seed = _key(states.source["seed"][row], Stream.RANDOM_WALK)
    if not 0 <= steps <= _LONGEST:
        raise InvalidInput(f"a random walk takes 0 to {_LONGEST} actions, got {steps}")
    return drawn_actions(seed, steps)


def _replayed(states: States, rows: Sequence[int], rope: Rope) -> dict[int, Array]:
    """Replay rows; return the final qpos (nq,) of each that could be replayed."""
    actions = {}
    for row in rows:
        with suppress(InvalidInput):  # a fault of the row
            actions[row] = _actions_of(states, row)
    if not actions:
        return {}
    ropes = simulation(states.engine, len(actions), rope, threads=0)
    ropes.set_qpos(states.source["start_qpos"][[*actions]])
    # rows of different lengths share a simulation: those that are done are not stepped
    each, whole = [*actions.values()], np.ones(len(actions), dtype=bool)
    lengths = np.array([*map(len, each)])
    for step in range(int(lengths.max())):
        replayed = np.minimum(lengths, step).sum() / lengths.sum()
        Counts.tell("states checked", rows[0] + replayed * len(rows) / 2, len(states))
        ids = np.flatnonzero(whole & (step < lengths))
        if len(ids):
            whole[ids] = ropes.act([each[k][step] for k in ids], ids)
    ends = zip(actions, ropes.qpos(), whole, strict=True)
    return {row: qpos for row, qpos, is_whole in ends if is_whole}


def _image_faults(path: str | Path, each: Map = map) -> Iterator[str]:
    """Yield the faults of a table: manifest and checksums, then rows and splits.

    Args:
        path: a folder made by `knotgym images`, or a single shard, whose rows alone are checked.
        each: `map` or a pool's, for shards; results keep the order.
    """
    folder = Path(path)
    image_table.arrow()
    if folder.is_dir():
        yield from _manifest_faults(folder)
    files = image_table.shards(path)
    parts, told = list[Any](), each(_shard_faults, files)
    for faults, part in Counts.over(told, "files of pictures", len(files)):
        yield from faults
        parts.append(part)
    if any(part is None for part in parts):  # a fault already
        return
    if len(table := image_table.arrow().concat_tables(parts)):
        yield from _split_faults(table)
    else:
        yield f"{folder.name} has no rows"


def _shard_faults(path: Path) -> tuple[list[str], Any]:
    """List the faults of the rows of a shard; return them and the columns that splits share.

    The rows are compared with its `content_sha256`. Of a shard that can't be read, or whose points
    aren't finite, no columns are returned.
    """
    faults = list[str]()
    try:
        table = image_table.read_table(path)
    except (InvalidFile, MissingFile) as error:
        return [str(error)], None
    for n, row in enumerate(image_table.rows_of(table)):
        try:
            of_row = list(_picture_faults(row))
        except _RAISED as error:
            of_row = [f"it can't be rendered or measured: {one_line(error)}"]
        faults += [f"{path.name} row {n}: {fault}" for fault in of_row]
    if not image_table.is_unchanged(table):
        faults.append(f"{path.name}: its rows were changed after writing (SHA-256 differs)")
    try:
        image_table.points_of(table)
    except InvalidFile:
        return faults, None
    return faults, table.select(_SHARED)


def _picture_faults(row: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of one row, as `read_rows` gives it."""
    if (name := row["appearance"]["name"]) not in APPEARANCES:
        yield f"appearance.name is {name!r}, should be {' or '.join(APPEARANCES)}"
        return
    drawer = Drawer.of(name)
    chosen = {field.name for field in fields(drawer.look)} - {"seed"}  # others are measured
    own = (column for columns in APPEARANCES[name].own_columns for column in columns)
    for column in ("appearance", *own):
        factors = row.get(column)
        for factor, value in factors.items() if isinstance(factors, dict) else ():
            low, high = AppearanceConfig.SIZES if factor == "size" else (-_MOST_DRAWN, _MOST_DRAWN)
            number = factor in chosen and isinstance(value, (int, float))
            if number and not low <= value <= high:
                yield f"{column}.{factor} is {value}, should be {low:g} to {high:g}"
                return
    points = np.array(row["points"], np.float64).reshape(-1, 3)

    def _derived(rope: RopeAtRest) -> dict[str, Any]:
        return image_table.derived(rope, drawer.drawn(rope.points, drawer.read(row)))

    yield from _derived_faults({**row, "points": points}, Rope(), _derived)
    if (colours := row["appearance"]["colours"]) not in _COLOURS:
        yield f"appearance.colours is {colours!r}, should be {' or '.join(_COLOURS)}"
    if row["split"] not in IMAGE_SPLITS:
        yield f"split is {row['split']!r}, should be {' or '.join(IMAGE_SPLITS)}"
    measured = Quality(**dict.fromkeys(Quality.UNITS, np.nan) | row["quality"])
    if missed := Limits.UNAMBIGUOUS.faults(measured, row["nx"]):
        yield f"the code is ambiguous in the picture: {', '.join(missed)}"


def _split_faults(table: Any) -> Iterator[str]:
    """Yield what splits share: near-duplicates and ropes; and codes or nx in the wrong split."""
    split, codes, nx = (np.array(table[name].to_pylist()) for name in ("split", "gauss_code", "nx"))
    sources = table["source"].to_pylist()
    numbers = [source["row"] for source in sources]
    # the ropes of several seeds have the same numbers
    ropes = [(source["seed"], source["rope"]) for source in sources]
    yield from shared_faults(image_table.points_of(table), split, ropes, numbers)
    # codes of test-nx have more crossings than any other split's, so they aren't compared
    marked = image_table.marks_base(table)
    held, seen = (
        {held_form(code, marked=marked) for code in set(codes[np.isin(split, names)].tolist())}
        for names in (("test-code",), ("train", "test"))
    )
    for code in sorted(held & seen):
        same = "" if marked else ", from another base or in another direction,"
        yield f"code {code or 'loop'}{same} is in test-code and in train or test"
    harder, trained = nx[split == "test-nx"], nx[split == "train"]
    if len(harder) and len(trained) and harder.min() <= trained.max():
        yield "test-nx has pictures with no more crossings than train"
    if len(set(numbers)) != len(numbers):
        yield "two rows have the same number"


def faults(located: Located, replay: Replay, each: Map = map, sample: int = 0) -> Iterator[str]:
    """Yield the faults of datasets, each as soon as it is found.

    If only replays differ, a last line says that machines round differently.

    Args:
        located: what a path or an id names.
        replay: plays episodes again.
        each: `map` or a pool's, for files of pictures; results keep the order.
        sample: how many drawn episodes of each dataset to play again; 0 for all.
    """
    if sample < 0:
        raise InvalidInput(f"sample must be at least 0, got {sample}")
    if located.pictures:
        every = _image_faults(located.pictures, each)
    elif located.states and located.root.is_dir():
        every = _folder_faults(located.root, replay, sample)
    elif located.states:
        every = _state_faults(read_states(located.states))
    else:
        verified = partial(episode_faults, replay=replay, sample=sample)
        every = chain(*map(_manifest_faults, located.listed), *map(verified, located.episodes))
    kinds = set[type]()
    for fault in every:
        kinds.add(type(fault))
        yield fault
    if kinds == {ReplayFault}:
        yield (
            f"{located.root}: only replays differ, and other machines may round differently; the"
            " manifest says which made it"
        )
