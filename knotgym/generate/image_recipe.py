"""The recipe of labelled pictures: frames of rollouts, rendered with an appearance.

Ropes start in the states of a file and are pulled, wave after wave, until every quota is full.
Frames are chosen one by one, then measured and rendered, one file of the table at a time
(`datasets.image_table`). All frames of a rope are in one split.

The Gauss code of a frame that may become a picture is certain, and the picture shows it. A frame
may be reflected, switched (over and under exchanged), reversed and renumbered from any bead; all of
these are exact for a picture. So a frame with n crossings can show up to 8n codes. Each frame comes
with a few symmetries, drawn at random, and the codes that it would show. Frames that a tilted
camera sees, such as those for photos, are in its axes, and everything is of its view.

Quotas are filled, codes balanced, and near-duplicates refused. Of the codes that a frame can show,
the one is taken that is rarest in its split so far. The choice depends only on the frames and their
order.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Failed, MissingExtra, Stream
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import STEPS, Episodes, PictureRow, finish_pictures, parquet, shard_name
from knotgym.envs import TaskConfig
from knotgym.generate.generate_config import ImagesConfig
from knotgym.generate.image_plan import Plan, Quota, form_of, plan_of
from knotgym.quality import base_spacing, grade_of, measure_all
from knotgym.rendering import APPEARANCES, AppearanceConfig, Drawer
from knotgym.runs import Call, Progress, Recipe, Result, RunOptions, compute, identity, run
from knotgym.states import IMAGE_SPLITS, NEAR, Spectra, read_states, resolve_states
from knotgym.topology import Crossings, Symmetry, find_crossings, pyknotid_code

_SYMMETRIES = 12  # drawn for each frame
_CHECKED = 16  # the frames of one rope in so many are read by pyknotid, too
# columns of frames
_FRAME: dict[str, Any] = {
    **{"points": np.float64, "rope": np.int64, "pulls": np.int64, "nx": np.int64},
    **{"ease": np.float64, "symmetries": np.int64, "codes": np.str_, "camera": np.float64},
}


def make_images(
    config: ImagesConfig,
    out: Path,
    options: RunOptions,
    *,
    states: str | Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make labelled pictures and return the new folder; a shard returns its journal.

    Args:
        config: which pictures.
        out: the folder.
        options: how the run is executed.
        states: that ropes start from, as `resolve_states` takes them.
        progress: shows what is done.

    Raises:
        Occupied, InvalidInput, Failed: as `runs.runner.run` raises.
        InvalidInput: such pictures can't be made of these states.
        MissingExtra: pyarrow isn't installed.
    """
    MissingExtra.imported("pyarrow", "huggingface", "Parquet")
    config.appearance.require_used()
    path = resolve_states(None if states is None else str(states))
    plan = plan_of(config, read_states(path, images=False))
    made = identity(config, {"name": path.name, "sha256": path})
    recipe = partial(_pictures, config, plan, made)
    return run(recipe, out, made, options, progress, compiles={"engine": config.engine})


def picture_block(config: ImagesConfig, number: int, count: int, seed: int) -> Any:
    """Return a pyarrow.Table of pictures for split train, as `ImagesConfig.pictured` describes."""
    plan, nx = _shipped_plan(config), config.trained
    each, more = divmod(count, len(nx))
    quota = {("train", crossings): each + (index < more) for index, crossings in enumerate(nx)}
    block_seed = Stream.STREAM_PICTURES.derived_seed(seed, number)
    pictures = _Pictures(replace(config, seed=block_seed), plan._replace(quota=quota))
    rows = [row for rows in compute(pictures.files()).values() for row in rows]
    return PictureRow.drawn(rows, config.appearance)


@lru_cache(maxsize=2)
def _shipped_plan(config: ImagesConfig) -> Plan:
    return plan_of(config, read_states(resolve_states(None), images=False))


def _pictures(config: ImagesConfig, plan: Plan, made: dict[str, Any], place: Path) -> Recipe[str]:
    """Make pictures in the new folder `place`; the result is a summary."""
    pictures = _Pictures(config, plan)
    rows_of = yield from pictures.files()
    results = yield [
        Call(f"rendering pictures {name}", _drawn, (rows, config.appearance), len(rows))
        for name, rows in rows_of.items()
    ]
    files = [place / name for name in rows_of]
    for path, result in zip(files, results, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(result["parquet"].tobytes())
    finish_pictures(place, pictures.report(), made)
    held_out = f"; all of nx {', '.join(map(str, config.held_nx))} in split test-nx"
    return f"{len(pictures.chosen)} pictures{held_out if config.held_nx else ''}"


def _drawn(rows: Sequence[PictureRow], config: AppearanceConfig) -> Result:
    """Render rows; return the bytes of their Parquet file."""
    return {"parquet": np.frombuffer(parquet(PictureRow.drawn(rows, config)), dtype=np.uint8)}


class _Pictures:
    """Configurations to be shown: ropes are pulled, wave after wave, until all quotas are full.

    Attributes:
        ropes: all ropes so far; the number of a rope is its index.
        chosen: what was chosen so far. Its `source` has rope, pulls, and the symmetry that was
            applied to the frame, and its camera is that in whose axes the points were before.
    """

    def __init__(self, config: ImagesConfig, plan: Plan) -> None:
        self.ropes, self.chosen = list[_PicturedRope](), list[PictureRow]()
        self._config, self._plan = config, plan
        # by quota: ropes that were pulled for it, and pictures that they gave
        self._pulled, self._gave = Counter[Quota](), Counter[Quota]()
        # pictures of a split with as many crossings, and those of grade extreme
        self._have, self._hardest = Counter[Quota](), Counter[Quota]()
        # why frames were dropped by `_frames_of`, and refused here
        self._frames, self._dropped, self._refused = 0, Counter[str](), Counter[str]()
        self._codes = Counter[tuple[str, str]]()
        self._known: Spectra | None = None  # of the chosen, in arrays with room for more

    def _filled(self) -> Recipe[None]:
        """Pull ropes until all quotas are full.

        Raises:
            Failed: several waves in a row brought no picture.
        """
        wave = idle = 0
        while lacking := self._lacking():
            before = len(self.chosen)
            for frames in (yield self._calls(wave, lacking)):
                counts = zip(frames["dropped"].tolist(), frames["count"].tolist(), strict=True)
                self._dropped.update(dict(counts))
                self._frames += len(frames["rope"]) + int(frames["count"].sum())
                for row, number in enumerate(frames["rope"].tolist()):
                    quota = self.ropes[number].quota
                    if reason := self._consider(frames, row, quota[0]):
                        self._refused[reason] += 1
                    else:
                        self._gave[quota] += 1
            wave += 1
            idle = 0 if len(self.chosen) > before else idle + 1
            if idle == self._config.idle:
                items = sorted(lacking.items())
                missing = ", ".join(f"{n} of {split} with nx {nx}" for (split, nx), n in items)
                raise Failed(
                    f"{before} of {sum(self._plan.quota.values())} pictures found, then none in"
                    f" {idle} waves of ropes; missing {missing}; start from more states"
                )

    def _lacking(self) -> dict[Quota, int]:
        """Return (split, nx) -> missing pictures, without full quotas."""
        lacking = {key: quota - self._have[key] for key, quota in self._plan.quota.items()}
        return {key: count for key, count in lacking.items() if count > 0}

    def _calls(self, wave: int, lacking: Mapping[Quota, int]) -> list[Call]:
        """Draw the ropes of the next wave and return what pulls them."""
        config, first = self._config, len(self.ropes)
        rng = Stream.IMAGE_WAVE.generator(config.seed, wave)
        # 10 % more ropes than the yield so far suggests, smoothed by 1 rope and 2 pictures
        yields = {key: (self._pulled[key] + 1) / (self._gave[key] + 2) for key in lacking}
        wanted = {key: int(np.ceil(1.1 * count * yields[key])) for key, count in lacking.items()}
        total = max(config.most_ropes, sum(wanted.values()))
        for key, count in wanted.items():
            few = max(1, count * config.most_ropes // total)
            for start in rng.choice(self._starts(*key), size=few).tolist():
                self.ropes.append(_PicturedRope(len(self.ropes), start, key))
            self._pulled[key] += few
        missing = {split: {nx for other, nx in lacking if other == split} for split in IMAGE_SPLITS}
        calls = []
        for at in range(first, len(self.ropes), config.ropes):
            group = self.ropes[at : at + config.ropes]
            start_qpos = self._plan.states.qpos[[rope.start for rope in group]]
            arguments = config, group, start_qpos, missing
            name = f"pulling ropes {at}-{at + len(group) - 1}"
            calls.append(Call(name, _frames_of, arguments, len(group)))
        return calls

    def _consider(self, frames: Result, row: int, split: str) -> str:
        """Choose a frame, or return why it is refused.

        Args:
            frames: as `_frames_of` returns them.
            row: which of them.
            split: that its rope is of.
        """
        key = split, int(frames["nx"][row])
        if self._plan.quota.get(key, 0) <= self._have[key]:
            return "quota full"
        is_extreme = grade_of(float(frames["ease"][row])) == "extreme"
        if is_extreme and self._hardest[key] >= self._config.extreme * self._plan.quota[key]:
            return "extreme enough"
        able = [
            (self._codes[split, code], index, code)
            for index, code in enumerate(frames["codes"][row].tolist())
            if code != "-" and self._may_show(code, split)
        ]
        if not able:
            return "no code wanted"
        _, index, code = min(able)
        symmetry = _symmetry_of(frames["symmetries"][row, index])
        points = symmetry.vertices(frames["points"][row])
        if not self._is_new(points, split):
            return "near-duplicate"
        self._have[key] += 1
        self._hardest[key] += is_extreme
        self._codes[split, code] += 1
        names = ("reflect", "switch", "reverse", "base_shift")
        source: dict[str, Any] = {name: int(frames[name][row]) for name in ("rope", "pulls")}
        source |= {name: getattr(symmetry, name) for name in names}
        tilt, heading = frames["camera"][row].tolist()
        self.chosen.append(PictureRow(points, split, source, (tilt, heading)))
        return ""

    def _may_show(self, code: str, split: str) -> bool:
        held_out = form_of(code, marked=self._config.marked) in self._plan.held_out
        return split == "test-nx" or held_out == (split == "test-code")

    def _is_new(self, points: Array, split: str) -> bool:
        """Whether no chosen configuration is a near-duplicate; if so, remember the points.

        Within a split only the same shape as it lies counts, across splits any symmetric one.
        """
        n, spectra = len(self.chosen), Spectra.of(points[None])
        known = self._known
        if known is None or n == len(known.square):  # full: double the room
            room = [np.zeros((max(2048, 2 * n), *c.shape[1:]), c.dtype) for c in spectra]
            for new, old in zip(room, known or (), strict=False):
                new[:n] = old
            known = self._known = Spectra(*room)
        apart = np.linalg.norm(known.invariants[:n] - spectra.invariants, axis=1)
        like = np.flatnonzero(apart < NEAR)
        if len(like) and (spectra.turned_distances(known.take(like)) < NEAR).any():
            return False
        others = like[[self.chosen[row].split != split for row in like.tolist()]]
        if len(others) and (spectra.pair_distances(known.take(others)) < NEAR).any():
            return False
        for column, values in zip(known, spectra, strict=True):
            column[n] = values[0]
        return True

    def files(self) -> Recipe[dict[str, list[PictureRow]]]:
        """Pull ropes until all quotas are full; return the rows of every file by its name.

        Each split's rows are in random order.

        Raises:
            Failed: several waves in a row brought no picture.
        """
        yield from self._filled()
        config, number = self._config, 0
        files: dict[str, list[PictureRow]] = {}
        for place, split in enumerate(IMAGE_SPLITS):
            chosen = [picture for picture in self.chosen if picture.split == split]
            rng = Stream.IMAGE_ORDER.generator(config.seed, place)
            order = rng.permutation(len(chosen)).tolist()
            firsts = range(0, len(chosen), config.rows_per_file)
            for index, first in enumerate(firsts):
                rows = files[shard_name(split, index, len(firsts))] = []
                for picture in (chosen[at] for at in order[first : first + config.rows_per_file]):
                    rope = self.ropes[picture.source["rope"]]
                    policy = config.policies[rope.number % len(config.policies)]
                    made = {"policy": policy, "start": rope.start, "seed": config.seed}
                    rows.append(picture._replace(source={**made, "row": number, **picture.source}))
                    number += 1
        return files

    def report(self) -> dict[str, Any]:
        """Return the numbers of ropes and frames, and of frames not used, by reason."""
        return {
            "ropes": len(self.ropes),
            "frames": self._frames,
            "dropped": dict(sorted(self._dropped.items())),
            "refused": dict(sorted(self._refused.items())),
        }

    def _starts(self, split: str, nx: int) -> NDArray[np.int64]:
        """Return the states that ropes of a quota start in.

        They have nx crossings; if there is none in the split, the nearest number.
        """
        crossings = self._plan.states.nx
        sides = [self._plan.split == split, crossings == 0]
        # plain loops are of no split, and quotas without crossings prefer them
        for side in reversed(sides) if nx == 0 else sides:
            if side.any():
                away = np.where(side, np.abs(crossings - nx), np.iinfo(np.int64).max)
                return np.flatnonzero(away == away.min())
        raise Failed(f"no state is left for {split} with nx {nx}; start from more states")


class _PicturedRope(NamedTuple):
    """A rope that is pulled.

    Attributes:
        number: of the rope in the run; all of its random draws follow from it.
        start: row of the states that it starts in.
        quota: that it is pulled for; all of its frames are of its split.
    """

    number: int
    start: int
    quota: Quota


def _frames_of(
    config: ImagesConfig,
    ropes: Sequence[_PicturedRope],
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
        `symmetries` int64 (m, _SYMMETRIES, 4), which are the fields reflect, switch, reverse and
        base_shift, and `codes` str (m, _SYMMETRIES), the Gauss code that each shows, or "-" if a
        crossing would be at the base bead. `camera` float64 (m, 2), tilt and heading, degrees.
        `dropped` and `count`: why frames were dropped, and how many.
    """
    look, frames = config.appearance, list[tuple[Any, ...]]()
    kind, drawer, sight = APPEARANCES[look.name], Drawer.of(look.name), (0.0, 0.0)
    dropped: Counter[str] = Counter()
    for (index, pulls), points in _observed(config, ropes, start_qpos).items():
        rope = ropes[index]
        if kind.tilted:
            camera = Stream.IMAGE_CAMERA.generator(config.seed, rope.number, pulls)
            points, sight = drawer.seen(points, look, camera)
        crossings = find_crossings(points)
        if crossings.nx in wanted[rope.quota[0]]:
            frames.append((points, rope.number, pulls, crossings, sight))
        else:
            dropped["crossings"] += 1
    seen = np.array([frame[0] for frame in frames])
    measured = measure_all(seen, [frame[3] for frame in frames], quick=True)
    rows = list[tuple[Any, ...]]()
    for (points, number, pulls, crossings, sight), whole in zip(frames, measured, strict=True):
        quality = replace(whole, base_spacing=np.inf)  # the base bead is chosen below
        faults = config.limits.faults(quality, crossings.nx)
        if not faults and not drawer.legible(points, min(look.sides), crossings):
            faults = ["illegible"]
        if not faults and number % _CHECKED == 0 and pyknotid_code(points) != crossings.code:
            faults = ["labellers disagree"]
        if faults:
            dropped[faults[0]] += 1
            continue
        rng = Stream.IMAGE_CHOICE.generator(config.seed, number, pulls)
        symmetries = rng.integers((2, 2, 2, len(points)), size=(_SYMMETRIES, 4))
        codes = _shown(points, crossings, symmetries, config)
        shown = points, number, pulls, crossings.nx, quality.ease()
        rows.append((*shown, symmetries, codes, sight))
    columns = zip(_FRAME.items(), zip(*rows, strict=True) if rows else [()] * 8, strict=True)
    return {
        **{name: np.array(values, kind) for (name, kind), values in columns},
        "dropped": np.array(list(dropped), np.str_),
        "count": np.array(list(dropped.values()), np.int64),
    }


def _symmetry_of(fields: NDArray[np.int64]) -> Symmetry:
    """Return the symmetry whose fields are reflect, switch, reverse and base_shift."""
    *flags, base_shift = fields.tolist()
    reflect, switch, reverse = map(bool, flags)
    return Symmetry(reflect=reflect, switch=switch, reverse=reverse, base_shift=base_shift)


def _observed(
    config: ImagesConfig, ropes: Sequence[_PicturedRope], start_qpos: Array
) -> dict[tuple[int, int], Array]:
    """Return the points of frames by index of the rope and pulls, in that order."""
    task = TaskConfig(task="unknot", nx=1, engine=config.engine, horizon=config.pulls, endless=True)
    points_of: dict[tuple[int, int], Array] = {}
    for turn, policy in enumerate(config.policies):
        turns = [k for k, rope in enumerate(ropes) if rope.number % len(config.policies) == turn]
        seeds = [Stream.IMAGE_WALK.derived_seed(config.seed, ropes[k].number) for k in turns]
        starts = Episodes.to_begin(start_qpos[turns], np.array(seeds, np.int64))
        acting, seen = make_policy(PolicyConfig(policy=policy)), STEPS.only("observation")
        played = rollouts(acting, task, starts, lanes=max(1, len(turns)), keep=seen)
        lengths = played.episodes["length"].tolist()
        for index, first, length in zip(turns, played.offsets.tolist(), lengths, strict=False):
            for pulls in range(config.stride, length + 1, config.stride):
                points = played.steps["observation"][first + pulls].astype(np.float64)
                if np.isfinite(points).all():
                    points_of[index, pulls] = points
    return dict(sorted(points_of.items()))


def _shown(
    points: Array, crossings: Crossings, symmetries: NDArray[np.int64], config: ImagesConfig
) -> list[str]:
    """Return the code that a frame shows after each symmetry; "-" if its base is at a crossing.

    Args:
        symmetries: int64 (n, 4), as `_frames_of` returns them.
    """
    reflect, switch, reverse, shift = symmetries.T
    moved = Symmetry(reflect=reflect, switch=switch, reverse=reverse, base_shift=shift)
    # the first bead of a reversed walk lies before the vertex that it starts at
    starts = np.where(reverse, -shift - 1, shift) % len(points)
    far = base_spacing(points, crossings, starts) >= (config.limits.base_spacing or 0.0)
    codes = crossings.texts_after(moved, len(points))
    return [code if shown else "-" for code, shown in zip(codes, far.tolist(), strict=True)]
