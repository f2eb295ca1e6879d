"""A hand-played episode: undo leaves no trace, and what is recorded is what a person pulled."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput, Occupied
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.play.recorder import Recorder
from knotgym.play.session import Session
from knotgym.states import read_states, write_states

from ..small_job import full_disk, staging_of

TASK = TaskConfig(task="tie", nx=1, observation="state", horizon=6)
PULLS = ((3, (1, 0, 0.5)), (40, (-1, 0.2, 0)), (77, (0, 0.7, -1)))
ID = "knotgym/tie-nx1/human-v0"


@pytest.fixture
def session() -> Session:
    return Session(TASK, seed=4)


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(TASK, 4, ID, "Ann", tmp_path) as recorder:
        yield recorder


def played(session: Session) -> bytes:
    for bead, force in PULLS:
        session.pull(bead, force)
    return session.batch.simulation.states().tobytes()


def stored(recorder: Recorder) -> int:
    return open_episodes(recorder.folder).episodes.episodes.rows


def test_undo_leaves_no_trace(session: Session) -> None:
    start = session.batch.simulation.states().tobytes()
    whole = played(session)
    session.undo()
    session.undo()
    session.pull(*PULLS[1])
    session.pull(*PULLS[2])
    assert session.batch.simulation.states().tobytes() == whole
    for _ in range(3):
        session.undo()
    assert session.batch.simulation.states().tobytes() == start
    assert not session.pulls


@pytest.mark.parametrize("force", [(np.nan, 0, 0), (1, 2), (np.inf, 0, 0)])
def test_a_force_that_is_none_is_ignored(session: Session, force: tuple[float, ...]) -> None:
    session.pull(5, force)
    assert not session.pulls


def test_a_bead_is_led_to_a_point_and_left_there(session: Session) -> None:
    target = session.points[20] + [0.0, 0.05, 0.02]
    while session.pull_towards(20, target):
        pass
    assert 1 <= len(session.pulls) < TASK.horizon
    assert np.linalg.norm(session.points[20] - target) < 0.013


def test_a_recording_is_a_dataset(session: Session, recorder: Recorder) -> None:
    number = recorder.next_number()
    session.begin(number)
    played(session)
    assert recorder.finish(number, session.pulls)
    assert recorder.next_number() == number + 1
    found = open_episodes(recorder.folder).episodes
    assert found.episodes["policy"].tolist() == ["human Ann"]
    assert found.steps["bead"][:4].tolist() == [3, 40, 77, 0]
    assert not found.steps["force"][3:].any()  # completed by leaving the rope alone


def test_a_killed_session_loses_and_doubles_nothing(session: Session, tmp_path: Path) -> None:
    for number in (0, 1):
        session.begin(number)
        played(session)
        with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
            assert recorder.recovered == number
            recorder.note(number, session.pulls)
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        assert recorder.recovered == 1 and recorder.next_number() == 2
        recorder.note(1, session.pulls)  # as if killed after publishing, before forgetting
        with pytest.raises(Occupied):
            Recorder(TASK, 4, ID, root=tmp_path).__enter__()
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        assert recorder.recovered == 0
    assert stored(recorder) == 2 and not staging_of(recorder.folder).exists()


def test_an_episode_whose_storing_failed_has_its_last_pull_when_it_is_recovered(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played(session)
    monkeypatch.setattr("knotgym.play.recorder.publish", full_disk)
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        recorder.note(0, session.pulls[:-1])  # the tab notes all but the one that ends an episode
        with pytest.raises(OSError, match="No space"):
            recorder.finish(0, session.pulls)
    monkeypatch.undo()
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        assert recorder.recovered == 1
    beads = open_episodes(recorder.folder).episodes.steps["bead"][: len(PULLS)]
    assert beads.tolist() == [bead for bead, _ in PULLS]


def test_an_episode_that_a_policy_pulled_in_is_not_stored(session: Session, tmp_path: Path) -> None:
    session.pull(*PULLS[0])
    session.let_act(PolicyConfig(policy="random"))
    session.pull(*PULLS[1])
    session.undo()
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        recorder.note(0, session.pulls)
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        assert recorder.recovered == 0
        assert not recorder.finish(0, session.pulls)
    assert not recorder.folder.exists()
    session.undo()  # the policy's pull
    assert not any(pull.helped for pull in session.pulls)


@pytest.mark.parametrize(
    ("task", "seed", "player"),
    [(replace(TASK, engine="chain"), 4, ""), (TASK, 5, ""), (TASK, 4, "Bob")],
    ids=["engine", "seed", "player"],
)
def test_another_session_s_pulls_are_not_taken_over(
    session: Session, tmp_path: Path, task: TaskConfig, seed: int, player: str
) -> None:
    played(session)
    with Recorder(TASK, 4, ID, root=tmp_path) as recorder:
        recorder.note(0, session.pulls)
    with pytest.raises(InvalidInput, match="different run"):
        Recorder(task, seed, ID, player, tmp_path).__enter__()


@pytest.mark.parametrize("other", [{"nx": 2}, {"states": "bench"}, {"states": "own"}])
def test_other_data_are_left_alone(
    session: Session, tmp_path: Path, states_path: str, other: dict[str, Any]
) -> None:
    """Rows of a set name its states, so that none of others join it; a file's name isn't asked."""
    file, other = tmp_path / "own.h5", dict(other)
    shutil.copyfile(states_path, file)
    task = replace(TASK, states=str(file)) if other.get("states") == "own" else TASK
    if other.get("states") == "own":
        session = Session(task, seed=4)
        other["states"] = str(tmp_path / "b.h5")
        write_states(Path(other["states"]), read_states(states_path).take(slice(1, None)))
    session.pull(*PULLS[0])
    with Recorder(task, 4, ID, root=tmp_path) as recorder:
        recorder.finish(0, session.pulls)
    before = {path: path.read_bytes() for path in recorder.folder.rglob("*") if path.is_file()}
    with pytest.raises(InvalidFile, match="isn't a recording of this task"):
        Recorder(replace(task, **other), 4, ID, root=tmp_path).__enter__()
    assert {path: path.read_bytes() for path in before} == before
    renamed = replace(task, states=str(file.rename(tmp_path / "c.h5")) if task.states else None)
    with Recorder(renamed, 4, ID, root=tmp_path) as recorder:
        assert recorder.next_number() == 1


@pytest.mark.parametrize("player", ["a\x1b[2J", "x" * 81])
def test_a_player_is_text(tmp_path: Path, player: str) -> None:
    with pytest.raises(InvalidInput, match="printable"):
        Recorder(TASK, 4, ID, player, tmp_path)
