"""Frames of rollouts that may become pictures, and the choice among them.

The Gauss code of such a frame is certain, and the picture shows it.

A frame may be reflected, switched (over and under exchanged), reversed and renumbered from any
bead; all of these are exact for a picture. So a frame with n crossings can show up to 8n codes.
Each frame comes with a few symmetries, drawn at random, and the codes that it would show.

Frames that a tilted camera sees, such as those for photos, are in its axes, and everything is of
its view.

Quotas are filled, codes balanced, and near-duplicates refused. Of the codes that a frame can show,
the one is taken that is rarest in its split so far. The choice depends only on the frames and their
order.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Stream, Table
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import STARTS, STEPS
from knotgym.envs import TaskConfig
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.quality import base_spacing, grade_of, measure
from knotgym.rendering import APPEARANCES, Drawer
from knotgym.rope import Array
from knotgym.runs import Result
from knotgym.states import NEAR, Spectra, held_form
from knotgym.topology import Symmetry, find_crossings, pyknotid_code

SYMMETRIES = 12  # drawn for each frame

Quota = tuple[str, int]  # split and nx


class PicturedRope(NamedTuple):
    """A rope that is pulled.

    Attributes:
        number: of the rope in the run; all of its random draws follow from it.
        start: row of the states that it starts in.
        split: the split of all its frames.
    """

    number: int
    start: int
    split: str


def frames_of(
    config: ImagesConfig,
    ropes: Sequence[PicturedRope],
    start_qpos: Array,
    wanted: dict[str, Collection[int]],
) -> Result:
    """Pull ropes and return the frames that may be shown.

    Args:
        config: how they are pulled, and the limits of frames.
        ropes: the ropes.
        start_qpos: float64 (ropes, nq), where they start.
        wanted: split -> numbers of crossings that are still missing.

    Returns:
        m frames, by rope and pulls: `points` float64 (m, beads, 3) in metres, `rope`, `pulls` and
        `nx` int64 (m,), `ease` float64 (m,) without the base bead (see `Quality.ease`),
        `symmetries` int64 (m, SYMMETRIES, 4), which are the fields reflect, switch, reverse and
        base_shift, and `codes` str (m, SYMMETRIES), the Gauss code that each shows, or "-" if a
        crossing would be at the base bead. `camera` float64 (m, 2), tilt and heading, degrees.
        `dropped` and `count`: why frames were dropped, and how many.
    """
    names = "points rope pulls nx ease symmetries codes camera".split()
    rows: dict[str, list[Any]] = {name: [] for name in names}
    look, sight = config.appearance, (0.0, 0.0)
    kind, drawer = APPEARANCES[look.name], Drawer.of(look.name)
    dropped: Counter[str] = Counter()
    for (index, pulls), points in _observed(config, ropes, start_qpos).items():
        rope = ropes[index]
        if kind.tilted:
            camera = Stream.IMAGE_CAMERA.generator(config.seed, rope.number, pulls)
            points, sight = drawer.seen(points, look, camera)
        crossings = find_crossings(points)
        if crossings.nx not in wanted[rope.split]:
            dropped["crossings"] += 1
            continue
        # the base bead is chosen below
        quality = replace(measure(points, crossings, quick=True), base_spacing=np.inf)
        faults = config.limits.faults(quality, crossings.nx)
        if not faults and pyknotid_code(points) != crossings.code:
            faults = ["labellers disagree"]
        if not faults and not drawer.legible(points, min(look.sides)):
            faults = ["illegible"]
        if faults:
            dropped[faults[0]] += 1
            continue
        rng = Stream.IMAGE_CHOICE.generator(config.seed, rope.number, pulls)
        symmetries = rng.integers((2, 2, 2, len(points)), size=(SYMMETRIES, 4))
        codes = [_shown(points, _symmetry_of(one), config) for one in symmetries]
        grade = quality.ease()
        row = points, rope.number, pulls, crossings.nx, grade, symmetries, codes, sight
        for column, value in zip(rows.values(), row, strict=True):
            column.append(value)
    kinds = {"rope": np.int64, "pulls": np.int64, "nx": np.int64, "ease": np.float64}
    return {
        "points": np.array(rows["points"] or np.empty((0, 0, 3)), np.float64),
        "symmetries": np.array(rows["symmetries"], np.int64).reshape(-1, SYMMETRIES, 4),
        "codes": np.array(rows["codes"], np.str_).reshape(-1, SYMMETRIES),
        "camera": np.array(rows["camera"], np.float64).reshape(-1, 2),
        **{name: np.array(rows[name], kind) for name, kind in kinds.items()},
        "dropped": np.array(list(dropped), np.str_),
        "count": np.array(list(dropped.values()), np.int64),
    }


def _symmetry_of(fields: NDArray[np.int64]) -> Symmetry:
    """Return the symmetry whose fields are reflect, switch, reverse and base_shift."""
    *flags, base_shift = fields.tolist()
    reflect, switch, reverse = map(bool, flags)
    return Symmetry(reflect=reflect, switch=switch, reverse=reverse, base_shift=base_shift)


def _observed(
    config: ImagesConfig, ropes: Sequence[PicturedRope], start_qpos: Array
) -> dict[tuple[int, int], Array]:
    """Return the points of frames by index of the rope and pulls, in that order."""
    task = TaskConfig(task="unknot", nx=1, engine=config.engine, horizon=config.pulls, endless=True)
    schema, found = STARTS.sized(nq=start_qpos.shape[1]), {}
    for turn, policy in enumerate(config.policies):
        own = [k for k, rope in enumerate(ropes) if rope.number % len(config.policies) == turn]
        starts, stream = schema.empty(len(own)), Stream.IMAGE_WALK
        starts["start_qpos"][:] = start_qpos[own]
        starts["seed"][:] = [stream.derived_seed(config.seed, ropes[k].number) for k in own]
        played = rollouts(
            make_policy(PolicyConfig(policy=policy)),
            task,
            Table(schema, starts),
            lanes=max(1, len(own)),
            keep=STEPS.only("observation"),
        )
        lengths = played.episodes["length"].tolist()
        for index, first, length in zip(own, played.offsets.tolist(), lengths, strict=False):
            for pulls in range(config.stride, length + 1, config.stride):
                points = played.steps["observation"][first + pulls].astype(np.float64)
                if np.isfinite(points).all():
                    found[index, pulls] = points
    return dict(sorted(found.items()))


def _shown(points: Array, symmetry: Symmetry, config: ImagesConfig) -> str:
    """Return the code that a frame shows after a symmetry, or "-"."""
    moved = symmetry.vertices(points)
    crossings = find_crossings(moved)
    least = config.limits.base_spacing or 0.0
    return str(crossings.code) if base_spacing(moved, crossings) >= least else "-"


class Chosen(NamedTuple):
    """A configuration to be shown.

    Attributes:
        points: float64 (beads, 3), metres.
        split: one of IMAGE_SPLITS.
        source: rope, pulls, and the symmetry that was applied to the frame.
        camera: tilt and heading of the camera in whose axes they were before that, degrees.
    """

    points: Array
    split: str
    source: dict[str, Any]
    camera: tuple[float, float]


class Chooser:
    """Fills quotas, frame by frame.

    Attributes:
        chosen: what was chosen so far.
        refused: reason -> number of refused frames.
    """

    def __init__(
        self, quota: Mapping[Quota, int], held_out: frozenset[str], config: ImagesConfig
    ) -> None:
        """Begin without any frame.

        Args:
            quota: (split, nx) -> number of pictures.
            held_out: codes, as `held_form` gives them, that only splits test-code and test-nx may
                show.
            config: of the pictures.
        """
        self.chosen, self.refused = list[Chosen](), Counter[str]()
        self._quota, self._held_out, self._config = quota, held_out, config
        self._forms = dict[str, str]()  # code -> its `held_form`
        self._have, self._hardest = Counter[Quota](), Counter[Quota]()
        self._codes = Counter[tuple[str, str]]()
        self._known: Spectra | None = None  # of the chosen, in arrays with room for more

    def lacking(self) -> dict[Quota, int]:
        """Return (split, nx) -> missing pictures, without full quotas."""
        lacking = {key: quota - self._have[key] for key, quota in self._quota.items()}
        return {key: count for key, count in lacking.items() if count > 0}

    def consider(self, frames: Result, row: int, split: str) -> bool:
        """Choose or refuse a frame; return whether it is chosen.

        Args:
            frames: as `frames_of` returns them.
            row: which of them.
            split: that its rope is of.
        """
        key = split, int(frames["nx"][row])
        if self._quota.get(key, 0) <= self._have[key]:
            return self._refuse("quota full")
        is_extreme = grade_of(float(frames["ease"][row])) == "extreme"
        if is_extreme and self._hardest[key] >= self._config.extreme * self._quota[key]:
            return self._refuse("extreme enough")
        able = [
            (self._codes[split, code], index, code)
            for index, code in enumerate(frames["codes"][row].tolist())
            if code != "-" and self._may_show(code, split)
        ]
        if not able:
            return self._refuse("no code wanted")
        _, index, code = min(able)
        symmetry = _symmetry_of(frames["symmetries"][row, index])
        points = symmetry.vertices(frames["points"][row])
        if not self._is_new(points, split):
            return self._refuse("near-duplicate")
        self._have[key] += 1
        self._hardest[key] += is_extreme
        self._codes[split, code] += 1
        names = ("reflect", "switch", "reverse", "base_shift")
        source: dict[str, Any] = {name: int(frames[name][row]) for name in ("rope", "pulls")}
        source |= {name: getattr(symmetry, name) for name in names}
        tilt, heading = frames["camera"][row].tolist()
        self.chosen.append(Chosen(points, split, source, (tilt, heading)))
        return True

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False

    def _may_show(self, code: str, split: str) -> bool:
        if split == "test-nx":
            return True
        if code not in self._forms:
            self._forms[code] = held_form(code, marked=self._config.marked)
        return (self._forms[code] in self._held_out) == (split == "test-code")

    def _is_new(self, points: Array, split: str) -> bool:
        """Whether no chosen configuration is a near-duplicate; if so, remember the points.

        Within a split only the same shape as it lies counts, across splits any symmetric one.
        """
        n, own = len(self.chosen), Spectra.of(points[None])
        known = self._known
        if known is None or n == len(known.square):  # full: double the room
            room = [np.zeros((max(2048, 2 * n), *one.shape[1:]), one.dtype) for one in own]
            for new, old in zip(room, known or (), strict=False):
                new[:n] = old
            known = self._known = Spectra(*room)
        like = np.flatnonzero(np.linalg.norm(known.invariants[:n] - own.invariants, axis=1) < NEAR)
        if (own.turned_distances(known.take(like)) < NEAR).any():
            return False
        others = like[[self.chosen[row].split != split for row in like.tolist()]]
        if (own.pair_distances(known.take(others)) < NEAR).any():
            return False
        for column, new in zip(known, own, strict=True):
            column[n] = new[0]
        return True
