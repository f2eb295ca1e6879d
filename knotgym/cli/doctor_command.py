"""The command `knotgym doctor`: digests of a fixed list, to compare machines.

Each row of `EXPECTED` is something that the same seed must make the same everywhere. The digests
were recorded on x86-64 with AVX2; docs/exact.md says which other processors give the same. Change
one only when its arrays change on purpose: `knotgym doctor` prints the new one.
"""

import hashlib
import tempfile
import tomllib
from collections.abc import Iterator
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from knotgym import datasets, drawing, generate, photos, rendering, runs, states, topology
from knotgym.cli.options import Given, command
from knotgym.common import Failed

EXPECTED = tomllib.loads((files("knotgym.cli") / "digests.toml").read_text("utf-8"))
_DECISIVE = ("knotgym", "mujoco", "numpy", "numba", "opencv-python-headless")  # of bytes
_ROPES, _FEW = 64, 8  # that move in the chain engine and in MuJoCo


@command({}, "")
def doctor(given: Given) -> None:
    """Compare digests of a fixed list with those recorded, in a minute.

    Prints one line each, "ok" or "differs", and the machine; exit status 0 only if all are equal.
    Where one differs, stored episodes of that kind don't replay to the bit on this machine.
    """
    progress = given.progress
    progress.stage("comparing digests")
    differs = []
    for name, digest in _measured():
        same = digest == EXPECTED[name]
        differs += [name] * (not same)
        expected = "" if same else f", recorded {EXPECTED[name]}"
        progress.say(f"{'ok' if same else 'differs':8}{digest}  {name}{expected}")
    facts = {**datasets.machine(), **{name: version(name) for name in _DECISIVE}}
    progress.say(", ".join(f"{key} {value}" for key, value in facts.items()))
    if differs:
        raise Failed(f"{len(differs)} of {len(EXPECTED)} differ: {', '.join(differs)}")


def _measured() -> Iterator[tuple[str, str]]:
    """Yield the name and the digest of each row of `EXPECTED`, in its order."""
    from knotgym.control import PolicyConfig, make_policy, rollouts
    from knotgym.envs import Marked, TaskConfig
    from knotgym.rope import CHAIN, MUJOCO, RopeConfig, simulation_of

    known = states.read_states(states.shipped(), images=False)
    rng = np.random.default_rng(0)
    shown: list[Any] = [known.points]
    chain, mujoco = (CHAIN, "chain engine", _ROPES, 1, 9, 60), (MUJOCO, "MuJoCo", _FEW, 1, 30)
    for engine, title, count, *stops in (chain, mujoco):
        ropes = simulation_of(count, RopeConfig(), engine)
        ropes.set_qpos(known.qpos[:: len(known) // count][:count])
        for action in range(1, stops[-1] + 1):
            ropes.act(rng.uniform(-1, 1, (count, 6)).astype(np.float32))
            if action in stops:
                yield f"{title}, {action} action{'s' * (action > 1)}", _digest(ropes.points)
        shown.append(ropes.points.copy())
    codes = [code.chiral for ropes_of in shown for code in topology.label_many(ropes_of)]
    yield "Gauss codes", _digest(codes)
    code = topology.GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c")
    curve = drawing.drawn_curve(code, np.random.default_rng(2))
    yield "drawn curves", _digest(curve)
    with tempfile.TemporaryDirectory() as folder:
        config = generate.GenerateConfig(nx=(2,), count=4, demonstrations=False)
        options, silent = runs.RunOptions(workers=1, quiet=True), runs.Progress(quiet=True)
        made = generate.make_states(config, Path(folder) / "made", options, progress=silent)
        table = states.read_states(made / "states.h5")
    yield "generated states", _digest(table.qpos, table.image, [*table.gauss_code_chiral])
    yield "picture", _digest(rendering.draw(known.points[-1]))
    shot = photos.photograph(known.points[100], 256, np.random.default_rng(0))
    yield "photo", _digest(shot.image if shot else [])
    task = TaskConfig(task="tie", nx=2, engine=CHAIN)
    played = rollouts(make_policy(PolicyConfig(policy="expert")), task, [0, 1])
    yield "expert's episode", _digest(played.steps["action"], played.steps["observation"])
    yield "marked observations", _digest(Marked.of(known.points, [code] * len(known)).joined())


def _digest(*values: Any) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of arrays, or of lists of text."""
    digest = hashlib.sha256()
    for value in values:
        text = isinstance(value, list)
        digest.update("\n".join(value).encode() if text else np.ascontiguousarray(value).tobytes())
    return digest.hexdigest()[:12]
