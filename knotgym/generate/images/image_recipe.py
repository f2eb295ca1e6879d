"""The recipe of labelled pictures: frames of rollouts, rendered with an appearance.

Ropes start in the states of a file and are pulled (`frames`), wave after wave, until every quota is
full. Frames are chosen one by one, then measured and rendered, one file of the table at
a time (`datasets.image_rows`). All frames of a rope are in one split.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Failed, InvalidInput, Stream
from knotgym.datasets import PictureRow, arrow, drawn_table, finish, parquet, shard_name
from knotgym.generate.images.frames import Chooser, PicturedRope, Quota, frames_of
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.rendering import AppearanceConfig
from knotgym.rope import RopeConfig
from knotgym.runs import (
    Call,
    Progress,
    Recipe,
    Result,
    RunOptions,
    compile_first,
    compute,
    identity,
    run,
)
from knotgym.states import IMAGE_SPLITS, States, families, held_form, read_states, resolve_states
from knotgym.topology import codes_of


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
    arrow()
    path = resolve_states(None if states is None else str(states))
    plan = _Plan.of(config, read_states(path, images=False))

    made = identity(config, {"name": path.name, "sha256": path})
    recipe = partial(_pictures, config, plan, made)
    compiles = partial(compile_first, engine=config.engine)
    return run(recipe, out, made, options, progress, prepare=compiles)


def picture_block(config: ImagesConfig, number: int, count: int, seed: int) -> Any:
    """Return a pyarrow.Table of pictures for split train, as `ImagesConfig.pictured` describes."""
    plan, nx = _plan_of(config), config.trained
    share, more = divmod(count, len(nx))
    quota = {("train", one): share + (index < more) for index, one in enumerate(nx)}
    own = Stream.STREAM_PICTURES.derived_seed(seed, number)
    waves = _Waves(replace(config, seed=own), plan._replace(quota=quota))
    compute(_filled(waves))
    files = _files(waves)
    return drawn_table([row for rows in files.values() for row in rows], config.appearance)


@lru_cache(maxsize=2)
def _plan_of(config: ImagesConfig) -> "_Plan":
    return _Plan.of(config, read_states(resolve_states(None), images=False))


class _Plan(NamedTuple):
    """What is made of which states.

    Attributes:
        quota: (split, nx) -> number of pictures.
        held_out: codes, as `held_form` gives them, held out for split test-code.
        states: with at most as many crossings as are asked for.
        split: str (n,), the split of the ropes that start in each; "" for any, at plain loops.
    """

    quota: dict[Quota, int]
    held_out: frozenset[str]
    states: States
    split: NDArray[np.str_]

    @classmethod
    def of(cls, config: ImagesConfig, states: States) -> "_Plan":
        if states.attributes.get("rope") != (fingerprint := RopeConfig().fingerprint):
            raise InvalidInput(
                f"the states were made with rope model {states.attributes.get('rope')}; this"
                f" version has {fingerprint}"
            )
        states = states.take(states.nx <= max(config.nx))
        if not len(states):
            raise InvalidInput(f"there is no state with at most {max(config.nx)} crossings")
        knots = sorted(set(states.knot.tolist()))
        codes = dict[int, list[str]]()
        for nx in config.nx:
            every = [str(code) for knot in knots for code in codes_of(knot, nx)]
            if not every:
                raise InvalidInput(f"no diagram of {' or '.join(knots)} has {nx} crossings")
            codes[nx] = sorted({held_form(code, marked=config.marked) for code in every})
        quota = _quotas(config, {nx: len(codes[nx]) for nx in codes})
        return cls(quota, _held_out(config, codes), states, _splits_of(config, states, set(quota)))


def _splits_of(config: ImagesConfig, states: States, wanted: set[Quota]) -> NDArray[np.str_]:
    """Return the split of the ropes that start in each state, str (n,).

    Near-duplicates, up to mirror images, reversal and renumbering, are in one split. It is "" for
    plain loops: ropes that start there may be in any split.
    """
    family, split = families(states.points), np.full(len(states), "", dtype="<U9")
    most = {one: int(states.nx[family == one].max()) for one in set(family.tolist())}
    for nx in sorted(set(most.values())):
        same = [one for one in sorted(most) if most[one] == nx]
        order = Stream.IMAGE_FAMILIES.generator(config.seed, nx).permutation(len(same))
        test = round(config.test_share * len(same)) or int(config.test_share > 0)
        new = (round(config.code_share * len(same)) or 1) * (("test-code", nx) in wanted)
        names = ["train", *["test"] * test, *["test-code"] * new, *["train"] * len(same)]
        for place, name in zip(order.tolist(), names, strict=False):
            split[family == same[place]] = "test-nx" if nx > max(config.trained) else name
    split[states.nx == 0] = ""
    return split


def _quotas(config: ImagesConfig, codes: dict[int, int]) -> dict[tuple[str, int], int]:
    """Return (split, nx) -> number of pictures.

    Args:
        config: of the pictures.
        codes: nx -> number of codes that can be held out.
    """
    out: dict[tuple[str, int], int] = {}
    for index, nx in enumerate(config.nx):
        here = config.count // len(config.nx) + (index < config.count % len(config.nx))
        if nx in config.held_nx:
            out["test-nx", nx] = here
            continue
        new = round(config.code_share * here) if codes[nx] >= 4 else 0
        test = round(config.test_share * here)
        out.update({("train", nx): here - test - new, ("test", nx): test, ("test-code", nx): new})
    return {key: wanted for key, wanted in out.items() if wanted}


def _held_out(config: ImagesConfig, codes: Mapping[int, Sequence[str]]) -> frozenset[str]:
    """Return the codes, as `states.held_form` gives them, held out for split "test-code"."""
    out: list[str] = []
    for nx in config.trained:
        if len(codes[nx]) >= 4 and config.code_share > 0:
            order = Stream.IMAGE_CODES.generator(config.seed, nx).permutation(len(codes[nx]))
            count = max(1, round(config.code_share * len(codes[nx])))
            out += [codes[nx][k] for k in order[:count].tolist()]
    return frozenset(out)


def _pictures(config: ImagesConfig, plan: _Plan, made: dict[str, Any], place: Path) -> Recipe[str]:
    """Make pictures in the new folder `place`; the result is a summary."""
    waves = yield from _filled(_Waves(config, plan))
    rows_of = _files(waves)
    results = yield [
        Call(f"rendering pictures {name}", _drawn, (rows, config.appearance), len(rows))
        for name, rows in rows_of.items()
    ]
    files = [place / name for name in rows_of]
    for path, result in zip(files, results, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(result["parquet"].tobytes())
    finish(place, waves.report(), made)
    return f"{len(waves.chooser.chosen)} pictures"


def _drawn(rows: Sequence[PictureRow], config: AppearanceConfig) -> Result:
    """Render rows; return the bytes of their Parquet file."""
    return {"parquet": np.frombuffer(parquet(drawn_table(rows, config)), dtype=np.uint8)}


def _filled(waves: "_Waves") -> Recipe["_Waves"]:
    """Pull ropes until all quotas are full."""
    while waves.chooser.lacking():
        waves.take((yield waves.calls()))
    return waves


class _Waves:
    """Ropes that are pulled, wave after wave, until their frames fill all quotas.

    Attributes:
        config: of the pictures.
        ropes: all ropes so far; the number of a rope is its index.
        chooser: chooses among their frames.
    """

    def __init__(self, config: ImagesConfig, plan: _Plan) -> None:
        self.ropes = list[PicturedRope]()
        self.chooser = Chooser(plan.quota, plan.held_out, config)
        self.config, self._plan = config, plan
        self._quota_of = list[Quota]()  # that each rope is for
        # by quota: ropes that were pulled for it, and pictures that they gave
        self._pulled, self._gave = Counter[Quota](), Counter[Quota]()
        self._frames, self._dropped = 0, Counter[str]()
        self._wave = self._idle = 0

    def calls(self) -> list[Call]:
        """Draw the ropes of the next wave and return what pulls them."""
        config, first = self.config, len(self.ropes)
        rng = Stream.IMAGE_WAVE.generator(config.seed, self._wave)
        lacking = self.chooser.lacking()
        # 10 % more ropes than the yield so far suggests, smoothed by 1 rope and 2 pictures
        yields = {key: (self._pulled[key] + 1) / (self._gave[key] + 2) for key in lacking}
        wanted = {key: int(np.ceil(1.1 * count * yields[key])) for key, count in lacking.items()}
        total = max(config.most_ropes, sum(wanted.values()))
        for key, count in wanted.items():
            few = max(1, count * config.most_ropes // total)
            for start in rng.choice(self._starts(*key), size=few).tolist():
                self.ropes.append(PicturedRope(len(self.ropes), start, key[0]))
                self._quota_of.append(key)
            self._pulled[key] += few
        missing = {split: {nx for one, nx in lacking if one == split} for split in IMAGE_SPLITS}
        calls = []
        for at in range(first, len(self.ropes), config.ropes):
            group = self.ropes[at : at + config.ropes]
            start_qpos = self._plan.states.qpos[[rope.start for rope in group]]
            arguments = config, group, start_qpos, missing
            name = f"pulling ropes {at}-{at + len(group) - 1}"
            calls.append(Call(name, frames_of, arguments, len(group)))
        return calls

    def take(self, results: list[Result]) -> None:
        """Choose among the frames of a wave.

        Raises:
            Failed: several waves in a row brought no picture.
        """
        before = len(self.chooser.chosen)
        for found in results:
            counts = zip(found["dropped"].tolist(), found["count"].tolist(), strict=True)
            self._dropped.update(dict(counts))
            self._frames += len(found["rope"]) + int(found["count"].sum())
            for row, number in enumerate(found["rope"].tolist()):
                chosen = self.chooser.consider(found, row, self.ropes[number].split)
                self._gave[self._quota_of[number]] += chosen
        self._wave += 1
        self._idle = 0 if len(self.chooser.chosen) > before else self._idle + 1
        if self._idle == self.config.idle:
            lacking = sorted(self.chooser.lacking().items())
            missing = ", ".join(f"{n} of {split} with nx {nx}" for (split, nx), n in lacking)
            raise Failed(
                f"{before} of {sum(self._plan.quota.values())} pictures found, then none in"
                f" {self._idle} waves of ropes; missing {missing}; start from more states"
            )

    def report(self) -> dict[str, Any]:
        """Return the numbers of ropes and frames, and of frames not used, by reason."""
        return {
            "ropes": len(self.ropes),
            "frames": self._frames,
            "dropped": dict(sorted(self._dropped.items())),
            "refused": dict(sorted(self.chooser.refused.items())),
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


def _files(waves: _Waves) -> dict[str, list[PictureRow]]:
    """Return the rows of every file by its name; each split's rows are in random order."""
    config, number = waves.config, 0
    files: dict[str, list[PictureRow]] = {}
    for place, split in enumerate(IMAGE_SPLITS):
        chosen = [one for one in waves.chooser.chosen if one.split == split]
        order = Stream.IMAGE_ORDER.generator(config.seed, place).permutation(len(chosen)).tolist()
        firsts = range(0, len(chosen), config.rows_per_file)
        for index, first in enumerate(firsts):
            rows = files[shard_name(split, index, len(firsts))] = []
            for one in (chosen[at] for at in order[first : first + config.rows_per_file]):
                rope = waves.ropes[one.source["rope"]]
                policy = config.policies[rope.number % len(config.policies)]
                made = {"policy": policy, "start": rope.start, "seed": config.seed, "row": number}
                rows.append(PictureRow(one.points, split, made | one.source, one.camera))
                number += 1
    return files
