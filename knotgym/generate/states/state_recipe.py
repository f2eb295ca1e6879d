"""The recipe of curated states: a run of `CurationRun`, saved after every cycle.

In the staging folder stand, until it is finished,

    run.json                counters, and the names of the files below; written last
    archive-{cycle}.h5      the search's archive after that cycle
    accepted/{nx}-{k}.npz   an accepted candidate each, written once
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import as_json
from knotgym.common.errors import KnotgymError, MissingFile
from knotgym.generate.states import state_folder
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.candidates import Candidate
from knotgym.generate.states.curation_run import CurationRun
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.quality.measures import Quality
from knotgym.runs.engine import Batch, run
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of

_RUN = "run.json"
CORE_SECONDS = (
    8.0  # a state, as all 57 codes up to nx 3 took 4 minutes on two cores; more from nx 4
)


class SpoiltCheckpoint(KnotgymError, ValueError):
    """What a run left to be resumed from is damaged."""

    def __init__(self, folder: Path, reason: object) -> None:
        said = " ".join(str(reason).split())
        super().__init__(f"{folder} can't be resumed, it is damaged ({said}); start with --restart")


def generate(
    config: GenerateConfig,
    out: Path,
    options: RunOptions,
    *,
    archive: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make curated states in the new folder `out`, or in that of the shard, and return it.

    Args:
        config: what is wanted.
        out: the folder of the whole run.
        options: how it is done.
        archive: of another run, to go on from.
        progress: to show it on.

    Raises:
        Occupied, InvalidRun: as of `runs.engine.run`.
        InvalidGenerateConfig: nothing of the kind can be made.
        NotEnough: the attempts allowed were spent.
    """
    recipe = StateRecipe(config, options, archive)
    if progress is not None:
        wanted = sum(
            config.every_code * len(codes_of("0_1", nx)) if config.every_code else config.count
            for nx in config.nx
        )
        tell_if_long(progress, CORE_SECONDS * wanted / options.shard.of, options.workers)
    return run(recipe, options.shard.folder(out), options, progress)


class StateRecipe:
    """Curated states, see `runs.engine.Recipe`."""

    flexible: tuple[str, ...] = ("attempts", "cycles")

    def __init__(self, config: GenerateConfig, options: RunOptions, archive: Path | None) -> None:
        if archive is not None and not archive.is_file():
            raise MissingFile(f"no archive at {archive}")
        self.config, self.shard, self.archive = config, options.shard, archive
        self.run: CurationRun

    def request(self) -> dict[str, Any]:
        curve = Path(self.config.knot)
        source = {
            "archive": sha256(self.archive) if self.archive else None,
            "knot": sha256(curve) if curve.is_file() else None,
        }
        return {"config": as_json(self.config), "source": source}

    def begin(self) -> None:
        archive = Archive.load(self.archive) if self.archive else None
        self.run = CurationRun.begin(self.config, self.shard, archive)

    def batches(self, folder: Path) -> Iterator[Batch]:
        return self.run.batches()

    def save(self, folder: Path) -> None:
        state = self.run
        accepted = [
            f"{nx}-{index:06d}.npz"
            for nx, candidates in state.accepted.items()
            for index in range(len(candidates))
        ]
        for name in accepted:
            if not (folder / "accepted" / name).is_file():
                nx, index = map(int, name.removesuffix(".npz").split("-"))
                _save_candidate(folder / "accepted" / name, state.accepted[nx][index])
        archive = folder / f"archive-{state.cycle:06d}.h5"
        state.archive.save(archive, compress=False)
        counters = {
            "cycle": state.cycle,
            "knot": state.knot,
            "actions": state.actions,
            "growth": state.growth,
            "rejected": {str(nx): dict(reasons) for nx, reasons in state.rejected.items()},
            "tried": {
                str(nx): [[str(code), count] for code, count in tried.items()]
                for nx, tried in state.tried.items()
            },
            "targeted": [[str(code), count] for code, count in state.targeted.items()],
            "archive": archive.name,
            "accepted": {name: sha256(folder / "accepted" / name) for name in accepted},
            "sha256": sha256(archive),
        }
        write_sealed(folder / _RUN, counters)
        for old in folder.glob("archive-*.h5"):
            if old != archive:
                old.unlink()

    def load(self, folder: Path) -> bool:
        if not (folder / _RUN).is_file():
            return False
        try:
            said = read_sealed(folder / _RUN)
            for name, digest in {
                said["archive"]: said["sha256"],
                **{f"accepted/{name}": digest for name, digest in said["accepted"].items()},
            }.items():
                if sha256(folder / name) != digest:
                    raise SpoiltCheckpoint(folder, f"SHA-256 of {name} differs")
            state = CurationRun.begin(
                self.config, self.shard, Archive.load(folder / said["archive"])
            )
            state.cycle, state.actions = int(said["cycle"]), int(said["actions"])
            state.growth = said["growth"]
            for nx in self.config.nx:
                state.rejected[nx] = Counter(said["rejected"][str(nx)])
                state.tried[nx] = _counted(said["tried"][str(nx)])
            state.targeted = _counted(said["targeted"])
            for name in said["accepted"]:
                nx = int(name.split("-")[0])
                state.accepted[nx].append(_load_candidate(folder / "accepted" / name))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
            if isinstance(error, SpoiltCheckpoint):
                raise
            raise SpoiltCheckpoint(folder, error) from error
        self.run = state
        return True

    def status(self) -> Status:
        state, config = self.run, self.config
        accepted = [one for candidates in state.accepted.values() for one in candidates]
        rejected: Counter[str] = sum(state.rejected.values(), Counter())
        known = ", ".join(
            f"nx {nx}: {len(state.archive.codes(nx))} of {state.existing[nx]}" for nx in config.nx
        )
        common = ", ".join(f"{reason} {count}" for reason, count in rejected.most_common(4))
        facts = {
            "distinct codes": f"{len({one.code.plain for one in accepted})}",
            "codes the search knows": known,
            "rejected": common or "none",
            "environment steps": f"{state.steps()}",
        }
        total = len(accepted) + sum(
            0 if state.has_enough(nx) else state.lacking(nx) for nx in config.nx
        )
        return Status(len(accepted), total, "states accepted", facts)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        state_folder.write(self.run, folder, request)
        return folder

    def summary(self) -> str:
        chosen = [one for nx in self.config.nx for one in self.run.chosen(nx)]
        return f"{len(chosen)} states of {len({one.code.plain for one in chosen})} codes"


def _counted(pairs: list[list[Any]]) -> Counter[GaussCode]:
    return Counter({GaussCode.parse(code).plain: int(count) for code, count in pairs})


def _save_candidate(path: Path, candidate: Candidate) -> None:
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            code=np.array(candidate.code.chiral),
            seed=np.array(candidate.seed, dtype=np.int64),
            start_qpos=candidate.start_qpos,
            actions=candidate.actions,
            points=candidate.points,
            qpos=candidate.qpos,
            steps=np.array(candidate.steps),
            quality=np.array(json.dumps(asdict(candidate.quality))),
        )


def _load_candidate(path: Path) -> Candidate:
    with np.load(path, allow_pickle=False) as file:
        return Candidate(
            code=GaussCode.parse(str(file["code"])),
            faults=(),
            seed=tuple(file["seed"].tolist()),
            start_qpos=file["start_qpos"],
            actions=file["actions"],
            points=file["points"],
            qpos=file["qpos"],
            quality=Quality(**json.loads(str(file["quality"]))),
            steps=int(file["steps"]),
        )
