"""An entry is its pulls: what is counted again is what was counted, and forgeries are refused."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pytest_types import Capture, Patch
from rich.console import Console

from knotgym.common import InvalidFile, KnotgymError, Stream, Table
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import EpisodeDataset, Episodes, open_episodes, write_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig, compare, evaluate, read_entry, verify
from knotgym.generate.entries import Entry, write_entry
from knotgym.generate.results import Result
from knotgym.runs import RunOptions

from ..small_job import knotgym

OLD = Path(__file__).parents[1] / "data/845eceab/entry.h5"  # of that commit
EPISODES = 6
CONFIG = EvaluateConfig(
    policies=(PolicyConfig(policy="expert"), PolicyConfig(policy="random")),
    episodes=EPISODES,
    seed=3,
    task=TaskConfig(task="tie", observation="state", engine="chain", horizon=20),
)
Made = tuple[Path, list[Result]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    path = tmp_path_factory.mktemp("entry") / "entry.h5"
    return path, evaluate(CONFIG, RunOptions(workers=1, quiet=True), record=path)


def rows_of(path: Path) -> tuple[list[Result], list[str]]:
    """What replaying an entry counts, and its faults."""
    found, faults = zip(*entry_at(path).recounted(), strict=True)
    return [*found], [one for own in faults for one in own]


def entry_at(path: Path) -> Entry:
    entry = read_entry(path)
    assert entry is not None
    return entry


def test_replaying_counts_what_was_counted(made: Made) -> None:
    path, results = made
    found, faults = rows_of(path)
    assert not faults and results[0].success_rate > results[1].success_rate
    claimed = {"planned_actions": 0.0}
    assert [asdict(one) for one in found] == [asdict(one) | claimed for one in results]
    said = entry_at(path).claimed
    assert said[0]["simulated_per_pull"] > 0 == said[1]["simulated_per_pull"]
    assert said[0]["files"] and said[0]["plans"] and not said[1]["plans"]


def test_an_entry_is_verified_and_a_damaged_one_said_to_be_one(made: Made, tmp_path: Path) -> None:
    assert verify(made[0]) == []
    damaged = tmp_path / "e.h5"
    for cut in (slice(0, 4000), slice(4, None)):
        damaged.write_bytes(made[0].read_bytes()[cut])
        with pytest.raises(InvalidFile, match="neither an entry .* nor a file of --out"):
            compare([damaged, made[0]], Console())


def test_an_entry_claims_what_its_policy_s_module_says(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    card = {"learner": "none", "data": {"knotgym/a-v0": "0" * 64}, "parameters": 0, "updates": 0}
    text = f"CARD = {card}\nact = lambda observation: [0.0] * 6\n"
    (tmp_path / "claiming.py").write_text(text)
    task = ("--task", "tie", "--nx", 2, "--engine", "chain", "--set", "task.horizon=2")
    words = ("--policy", "claiming:act", *task, "--episodes", 1, "--workers", 1, "--quiet")
    assert knotgym("evaluate", *words, "--record", "entry.h5") == 0
    (claimed,) = entry_at(Path("entry.h5")).claimed
    assert claimed["training"] == card and "commit" in claimed and "command" not in claimed
    (tmp_path / "wrong.py").write_text(text.replace("'none'", "{1, 2}"))
    assert knotgym("evaluate", "--policy", "wrong:act", *words[2:], "--record", "w.h5") == 2


@pytest.mark.parametrize(("policy", "most"), [("random", 16), ("scripted", 5)])
def test_a_step_takes_few_bytes(tmp_path: Path, policy: str, most: int) -> None:
    config = replace(CONFIG, policies=(PolicyConfig(policy=policy),), episodes=32)
    evaluate(config, RunOptions(workers=1, quiet=True), record=tmp_path / "entry.h5")
    (one,), fixed = entry_at(tmp_path / "entry.h5").setups, 40_000  # HDF5's own structures
    assert (tmp_path / "entry.h5").stat().st_size < most * one.steps.rows + fixed
    assert not rows_of(tmp_path / "entry.h5")[1]


def test_an_entry_under_the_name_of_a_policy_of_the_package_is_found_out(
    made: Made, tmp_path: Path
) -> None:
    """The expert's pulls are random's, by the file's own words, and the other way round."""

    def _swap(said: dict[str, Any], own: Any, steps: Any) -> None:
        said["config"]["policies"] = said["config"]["policies"][::-1]

    forgery = forged(made[0], tmp_path / "swapped.h5", _swap)
    assert any("played again, pulls otherwise" in fault for fault in verify(forgery))


@pytest.mark.usefixtures("sound")
def test_the_command_verifies_an_entry(made: Made, capsys: Capture) -> None:
    assert knotgym("dataset", "verify", made[0]) == 0
    said = "".join(capsys.readouterr())
    assert "expert" in said and "claimed" in said and "all replayed" in said
    assert knotgym("dataset", "verify", made[0], "--quiet") == 0
    assert not "".join(capsys.readouterr())


def forged(source: Path, path: Path, change: Callable[[dict[str, Any], Any, Any], Any]) -> Path:
    """Write an entry with changes, and digests that fit them."""
    dataset = open_episodes(source)
    said = {**dataset.attributes, **dataset.attributes["protocol"]}
    own, steps = ({name: column.copy() for name, column in one.items()} for one in dataset.episodes)
    own, steps = change(said, own, steps) or (own, steps)
    facts = {name: said.get(name) for name in ("tasks", "claims")}
    facts["protocol"] = {name: said[name] for name in ("config", "states")}
    schemas = (one.schema for one in dataset.episodes)
    made = Episodes(*(Table(*one) for one in zip(schemas, (own, steps), strict=True)))
    write_episodes(path, [made], dataset.task, facts)
    sealed = EpisodeDataset.seal({**open_episodes(path).attributes, "rope": said["rope"]})
    with h5py.File(path, "r+") as file:
        file.attrs["attributes"] = np.array(sealed.encode(), h5py.string_dtype("utf-8", 64))
        file.attrs["rope"] = np.array(said["rope"].encode(), h5py.string_dtype("utf-8", 16))
    return path


def _taken(own: Any, steps: Any, order: list[int]) -> Any:
    ends = np.cumsum(own["length"] + 1)
    rows = np.concatenate([np.arange(ends[k] - own["length"][k] - 1, ends[k]) for k in order])
    return (
        {name: column[order] for name, column in own.items()},
        {name: column[rows] for name, column in steps.items()},
    )


def _set(**task: Any) -> Callable[..., None]:
    def change(said: dict[str, Any], own: Any, steps: Any) -> None:
        said["config"]["task"] |= task
        said["tasks"] = [{**one, **task} for one in said["tasks"]]

    return change


def _longer(said: dict[str, Any], own: Any, steps: Any) -> Any:
    end = int(own["length"][0])
    own["length"][0] += 1
    return own, {name: np.insert(column, end, column[end - 1], 0) for name, column in steps.items()}


def _put(table: int, name: str, value: Any) -> Callable[..., None]:
    def change(said: dict[str, Any], *tables: Any) -> None:
        tables[table][name][0] = value

    return change


ALL = range(2 * EPISODES)
FORGERIES: dict[str, Callable[..., Any]] = {
    "left out": lambda said, own, moved: _taken(own, moved, [*ALL][1:]),
    "repeated": lambda said, own, moved: _taken(own, moved, [0, 0, *ALL[2:]]),
    "reordered": lambda said, own, moved: _taken(own, moved, [1, 0, *ALL[2:]]),
    "split": lambda said, own, moved: said["config"].update(splits=["train"]),
    "seed": lambda said, own, moved: said["config"].update(seed=4),
    "task": lambda said, own, moved: said["config"].update(tasks=["unknot"]),
    "set": _set(states="random-walk"),
    "engine": _set(engine="mujoco"),
    "limit": _set(horizon=5),
    "setups": lambda said, own, moved: (said.pop("tasks"), own.pop("setup"))[2:],
    "rope": lambda said, own, moved: said.update(rope="0" * 16),
    "states": lambda said, own, moved: said.update(states={"readable": "0" * 64}),
    "after the end": _longer,
    "force": _put(1, "force", 2.0),
    "no number": _put(1, "force", np.nan),
    "bead": _put(1, "bead", 1000),
    "pull": _put(1, "bead", 77),
    "success": _put(0, "success", False),
    "return": _put(0, "return_", -3.0),
    "claims": lambda said, own, moved: said.update(claims=said["claims"][1:]),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_is_refused_in_one_line(name: str, made: Made, tmp_path: Path) -> None:
    path = forged(made[0], tmp_path / "forged.h5", FORGERIES[name])
    try:
        _, faults = rows_of(path)
    except KnotgymError as error:
        faults = [str(error)]
    assert faults and not any("\n" in fault for fault in faults)


def test_one_byte_changed_is_refused_or_without_effect(made: Made, tmp_path: Path) -> None:
    data, path, rng = made[0].read_bytes(), tmp_path / "changed.h5", np.random.default_rng(0)
    whole, refused = entry_at(made[0]), 0
    for place in rng.integers(len(data), size=150).tolist():
        changed = bytearray(data)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            entry = read_entry(path)
        except KnotgymError:
            entry = None
        if entry is None:  # it is refused, or says no more that it is an entry
            refused += 1
            continue
        assert entry.config == whole.config and entry.claimed == whole.claimed
        for one, other in zip(entry.setups, whole.setups, strict=True):
            assert other.differences(one) == []
    assert refused > 50


def test_an_entry_in_a_folder_begins_as_its_seeds_say(tmp_path: Path) -> None:
    config = replace(CONFIG, policies=(PolicyConfig(policy="random"),))
    (policy, task), seed = next(config.setups()), Stream.EVALUATION_EPISODE.derived_seed
    own = rollouts(make_policy(policy), task, [seed(config.seed, k) for k in range(EPISODES)])
    starts = own.episodes.replaced(start_qpos=own.episodes["start_qpos"] + 1e-6)
    file = tmp_path / "mine-v0/data/episodes.h5"
    file.parent.mkdir(parents=True)
    moved = rollouts(make_policy(policy), task, starts)  # from noise that no seed draws
    write_entry(file, config, [moved], [{"action": "pull"}])
    assert verify(file) and verify(file.parents[1])


@pytest.mark.usefixtures("sound")
def test_an_entry_is_a_dataset(made: Made, tmp_path: Path) -> None:
    """Which goals failed can be looked up, and the old format is read."""
    for words in ("show", "verify", "select --where success", "export --to columns", "page"):
        out = () if words in ("show", "verify") else ("--out", tmp_path / f"{words[:4]}.html")
        assert knotgym("dataset", *words.split(), made[0], *out) == 0, words
    for name in ("left out", "reordered", "seed"):  # in Python, too
        assert verify(forged(made[0], tmp_path / f"{name}.h5", FORGERIES[name]))
    (results, faults), old = rows_of(OLD), read_entry(OLD)
    assert old is not None and not faults and [one.successes for one in results] == [1, 0]
