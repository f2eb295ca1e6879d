"""A hand-played episode: undo and reset leave no trace, recordings are datasets like any other."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from knotgym.common.errors import InvalidFile, InvalidPolicy, Occupied
from knotgym.control.old_policies import make_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import EVALUATION, rollout
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.minari_dataset import metadata_of
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays
from knotgym.play.recorder import Recorder
from knotgym.play.session import Session
from knotgym.runs.staging import staging_folder

TASK = TaskConfig(task="tie", nx=1, observation="state", horizon=6)
PULLS = ((3, (1, 0, 0.5)), (40, (-1, 0.2, 0)), (77, (0, 0.7, -1)))


@pytest.fixture
def session() -> Session:
    return Session(TASK, seed=4)


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(TASK, 4, "knotgym/tie-nx1/human-v0", "Ann", tmp_path) as recorder:
        yield recorder


def played(session: Session) -> bytes:
    for bead, force in PULLS:
        session.pull(bead, force)
    return session.episodes.simulation.states().tobytes()


def test_undo_and_reset_leave_no_trace(session: Session) -> None:
    start = session.episodes.simulation.states().tobytes()
    whole = played(session)
    session.undo()
    session.undo()
    session.pull(*PULLS[1])
    session.pull(*PULLS[2])
    assert session.episodes.simulation.states().tobytes() == whole
    session.reset()
    assert session.episodes.simulation.states().tobytes() == start
    assert session.left == TASK.horizon
    assert not session.actions


@pytest.mark.parametrize("force", [(np.nan, 0, 0), (1, 2), (np.inf, 0, 0)])
def test_a_force_that_is_none_is_ignored(session: Session, force: tuple[float, ...]) -> None:
    session.pull(5, force)
    assert not session.actions


def test_a_bead_is_led_to_a_point_and_left_there(session: Session) -> None:
    target = session.points[20] + [0.0, 0.05, 0.02]
    pulls = 0
    while session.pull_towards(20, target):
        pulls += 1
    assert 1 <= pulls < TASK.horizon
    assert np.linalg.norm(session.points[20] - target) < 0.013


def test_a_hint_doesnt_touch_the_episode(session: Session) -> None:
    session.pull(*PULLS[0])
    before = session.episodes.simulation.states().tobytes()
    seen = session.foresee("scripted")
    assert seen.path.shape[1] == 3
    assert len(seen.path) >= 2
    assert session.episodes.simulation.states().tobytes() == before
    assert not session.helped


def test_an_unknown_policy_is_one_line(session: Session) -> None:
    with pytest.raises(InvalidPolicy, match="no policy 'nobody'"):
        session.foresee("nobody")


def test_a_recording_is_a_dataset(session: Session, recorder: Recorder) -> None:
    number = recorder.next_number()
    session.begin(number)
    played(session)
    assert not recorder.finish(number, session.actions)
    assert recorder.next_number() == number + 1
    assert verify_episodes(recorder.folder, act_out=True) == []
    episode = EpisodeReader(recorder.folder).episode(0)
    assert episode.policy == "human Ann"
    np.testing.assert_array_equal(episode.actions[:3], np.stack(session.actions))
    assert episode.move is not None
    assert episode.move.tolist() == ["", "hand", "hand", "hand", "rest", "rest", "rest"]
    assert arrays(recorder.folder, observation="state")["actions"].shape == (6, 6)
    metadata = metadata_of(recorder.folder)
    assert metadata is not None
    assert metadata.algorithm_name == "human"


def test_a_recording_is_evaluated(session: Session, recorder: Recorder) -> None:
    session.pull(*PULLS[0])
    recorder.finish(0, session.actions)
    policy = make_policy(PolicyConfig(policy=f"recorded:{recorder.folder}"))
    again = rollout(TASK, policy, [0], 4, streams=EVALUATION)[0].episode
    np.testing.assert_array_equal(again.points, EpisodeReader(recorder.folder).episode(0).points)
    with pytest.raises(InvalidPolicy, match="has 1 episodes, but none with this start"):
        rollout(TASK, policy, [1], 4, streams=EVALUATION)


def test_a_killed_session_loses_nothing(session: Session, tmp_path: Path) -> None:
    identifier = "knotgym/tie-nx1/human-v0"
    for number in (0, 1):
        session.begin(number)
        played(session)
        with Recorder(TASK, 4, identifier, root=tmp_path) as recorder:
            assert recorder.recovered == number
            recorder.journal(number, session.actions)
    with Recorder(TASK, 4, identifier, root=tmp_path) as recorder:
        assert recorder.recovered == 1
        assert recorder.next_number() == 2
        with pytest.raises(Occupied), Recorder(TASK, 4, identifier, root=tmp_path):
            pass
    assert len(EpisodeReader(recorder.folder)) == 2
    assert verify_episodes(recorder.folder, act_out=True) == []


def test_other_data_are_left_alone(session: Session, recorder: Recorder) -> None:
    session.pull(*PULLS[0])
    recorder.finish(0, session.actions)
    other = TaskConfig(task="tie", nx=2, observation="state")
    with pytest.raises(InvalidFile, match="isn't a recording of this task"):
        Recorder(other, 4, "knotgym/tie-nx1/human-v0", root=recorder.folder.parents[2])


def test_a_broken_journal_is_one_line(tmp_path: Path) -> None:
    recorder = Recorder(TASK, 4, "knotgym/tie-nx1/human-v0", root=tmp_path)
    journal = staging_folder(recorder.folder) / "journal-0.jsonl"
    journal.parent.mkdir(parents=True)
    journal.write_text('{"number": 0, "actions": [[1, 2]]}')
    with pytest.raises(InvalidFile, match="isn't a journal"), recorder:
        pass


@pytest.mark.parametrize("player", ["a\x1b[2J", "x" * 81])
def test_a_player_is_text(tmp_path: Path, player: str) -> None:
    with pytest.raises(InvalidFile, match="printable"):
        Recorder(TASK, 4, "knotgym/tie-nx1/human-v0", player, tmp_path)
