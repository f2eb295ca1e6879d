"""A stranger changes what an engine does: sets of before and after are never mixed in silence."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch
from rich.console import Console

import knotgym
from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig
from knotgym.datasets import merge
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, EvaluateConfig, collect, compare, evaluate
from knotgym.rope import ENGINES, Rope, engines
from knotgym.rope.chain import chain_simulation
from knotgym.runs import RunOptions

ALONE = RunOptions(workers=1, quiet=True)
TASK = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=5)
RANDOM = PolicyConfig(policy="random")


def made(folder: Path) -> str:
    """Collect and evaluate; the set, whose file is FOLDER/..., and FOLDER.json."""
    config = EvaluateConfig(task=TASK, nx=(1,), policies=(RANDOM,), episodes=2)
    evaluate(config, ALONE, out=folder.with_suffix(".json"))
    return str(collect(CollectConfig(task=TASK, policy=RANDOM, episodes=3), folder, ALONE))


def test_another_contact_stiffness(tmp_path: Path, monkeypatch: Patch) -> None:
    """What other physics made is refused by name: merged, compared, verified."""
    old, physics = made(tmp_path / "old"), chain_simulation._physics_of

    def stiff(rope: Rope) -> Any:
        own = physics(rope)
        return own._replace(contact_stiffness=8 * own.contact_stiffness)

    with monkeypatch.context() as patch:
        patch.setattr(chain_simulation, "_physics_of", stiff)
        patch.setattr(engines, "_shared", {})
        patch.setattr(engines, "_fixed_run", cache(engines._fixed_run.__wrapped__))
        new = made(tmp_path / "new")
        assert knotgym.verify(new) == []
        (fault,) = knotgym.verify(old)
    assert "made with an engine that does otherwise" in fault
    with pytest.raises(InvalidInput, match="that do otherwise made these datasets: .*old.*new"):
        merge([old, new], tmp_path / "both.h5")
    with pytest.raises(InvalidInput, match="that do otherwise played these results: .*new.json"):
        compare([tmp_path / "old.json", tmp_path / "new.json"], Console())


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engine_s_digest_is_the_same_on_all_processors(engine: str) -> None:
    """They differ by 1e-12 m at most, and no coordinate is as near to where rounding turns."""
    place = 1e6 * engines._fixed_run(ENGINES[engine].simulation)
    assert np.abs(place - np.floor(place) - 0.5).min() > 1e-4
