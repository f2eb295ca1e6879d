"""The recipes that the contract of runs is tested with; a recipe that lands adds a row.

A row makes an output of a few calls, in a second or so, in any process.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from knotgym import generate
from knotgym.control import PolicyConfig
from knotgym.envs import TaskConfig
from knotgym.runs.identities import Identity
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import RunOptions, Shard
from knotgym.runs.runner import Call, Recipe, run


def drawn(seed: int, number: int, scale: float) -> dict[str, Any]:
    rng = np.random.default_rng([seed, number])
    return {"x": scale * rng.normal(size=(50, 3)), "number": np.int64(number)}


def toy(place: Path) -> Recipe[str]:
    """Two batches, of which the second depends on the first."""
    parts = yield [Call(f"parts {number}", drawn, (0, number, 1.0)) for number in range(30)]
    scale = float(sum(part["x"].sum() for part in parts))
    more = yield [Call(f"more {number}", drawn, (1, number, scale)) for number in range(5)]
    place.mkdir()
    (place / "x.h5").write_bytes(b"".join(part["x"].tobytes() for part in [*parts, *more]))
    return f"{len(parts)} parts"


def made_toy(out: Path, options: RunOptions) -> Path:
    identity = Identity({"config": {"toy": 0}})
    whole = {**dict.fromkeys(("source", "versions", "rope")), **identity}
    return run(toy, out, identity, options, identity_in=lambda at: at.exists() and whole)


CHAIN = TaskConfig(task="tie", nx=2, engine="chain", observation="state", horizon=5)


def collected(out: Path, options: RunOptions) -> Path:
    policy = PolicyConfig(policy="scripted")
    config = generate.CollectConfig(task=CHAIN, policy=policy, episodes=130, dataset_id=out.name)
    return generate.collect(config, out.parent, options)


def evaluated(out: Path, options: RunOptions) -> Path:
    config = generate.EvaluateConfig(nx=(1, 2), episodes=70, task=CHAIN)
    with Progress(options.quiet) as progress:  # as the command; the function alone says nothing
        generate.evaluate(config, options, out=out, progress=progress)
    return out if options.shard.is_whole else options.shard.journal(out)


def made_states(out: Path, options: RunOptions) -> Path:
    config = generate.GenerateConfig(nx=(0, 1), count=4, engine="chain")
    return generate.make_states(config, out, options)


def made_images(out: Path, options: RunOptions) -> Path:
    config = generate.ImagesConfig(
        nx=(0, 1), count=8, engine="chain", pulls=4, ropes=2, rows_per_file=2
    )
    return generate.make_images(config, out, options)


RECIPES: dict[str, Callable[[Path, RunOptions], Path]] = {
    "toy": made_toy,
    "collect-v0": collected,
    "evaluate.json": evaluated,
    "states": made_states,
    "images": made_images,
}


def content(out: Path) -> dict[str, bytes]:
    """The bytes of each file of an output."""
    files = [out] if out.is_file() else sorted(path for path in out.rglob("*") if path.is_file())
    return {path.relative_to(out.parent).as_posix(): path.read_bytes() for path in files}


if __name__ == "__main__":  # python -m tests.runs.recipes NAME OUT WORKERS [SHARD]
    name, out, workers, *shard = sys.argv[1:]
    options = RunOptions(
        workers=int(workers), resume=True, quiet=True, shard=Shard.parse("".join(shard))
    )
    RECIPES[name](Path(out), options)
