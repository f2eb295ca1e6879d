"""Streams: batches of episodes and pictures that are made as they are needed."""

import multiprocessing
import pickle
from importlib.util import find_spec
from itertools import islice, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, ImagesConfig, collect
from knotgym.loaders import Transitions, Window, stream
from knotgym.loaders.data_stream import DataStream
from knotgym.runs import RunOptions

TASK = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=6)
CONFIG = CollectConfig(task=TASK, policy=PolicyConfig(policy="random"), episodes=8, form="columns")
PICTURES = ImagesConfig(engine="chain", nx=(0, 1, 2), count=40)
SMALL: dict[str, Any] = {"batch": 8, "block": 4, "shuffled": 2, "repeats": 2}


def made(**words: Any) -> DataStream:
    return stream(CONFIG, 3, **{**SMALL, **words})


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        np.array_equal(np.asarray(one[name]), np.asarray(other[name])) for name in one
    )


def test_the_first_blocks_are_the_episodes_of_a_collection(tmp_path: Path) -> None:
    folder = collect(CollectConfig(**{**vars(CONFIG), "seed": 3}), tmp_path, RunOptions(workers=1))
    stored = open_episodes(folder).episodes
    for block in (0, 1):
        numbers = range(4 * block, 4 * block + 4)
        played, right = CONFIG.played(numbers, 3), stored.select(np.array(numbers))
        assert np.array_equal(played.steps["observation"], right.steps["observation"])
        assert np.array_equal(played.steps["action"], right.steps["action"])
    held = Transitions(folder).batch(np.arange(len(Transitions(folder))))
    for batch in islice(made(), 2):
        for seen in batch["observations"]:
            assert (held["observations"] == seen).all(axis=1).any()


def test_a_block_gives_each_of_its_rows_before_one_comes_again() -> None:
    few = made(shuffled=1, batch=6, repeats=4, block=4)  # 24 transitions at most
    seen = np.concatenate([batch["observations"] for batch in islice(few, 4)])
    rows = len(Transitions(few._block(0).dataset))  # type: ignore[union-attr]
    assert len(np.unique(seen, axis=0)) == min(rows, 24)


def test_pictures_are_those_of_the_train_split() -> None:
    pictures = stream(PICTURES, 1, **SMALL)
    first, second = islice(pictures, 2)
    assert first["image"].shape == (8, 3, 128, 128) and first["image"].dtype == np.uint8
    assert not same(first, second) and same(first, pictures._batch_of(0))
    assert set(first["nx"]) <= {0, 1}, "2 is held out for split test-nx"
    names = {"image", "nx", "visits", "signs", "crossings", "grade", "accepted"}
    assert set(first) == names


def test_a_stream_goes_on_where_another_was() -> None:
    whole = [*islice(made(), 4)]
    first = made()
    for k, batch in enumerate(islice(first, 2)):
        assert same(batch, whole[k])
        state = pickle.loads(pickle.dumps(first.state_dict()))
        again = made()
        again.load_state_dict(state)
        assert same(next(iter(again)), whole[k + 1])
    # a copy in another process, and another iterator of the same stream, go on, too
    assert same(next(iter(pickle.loads(pickle.dumps(first)))), whole[2])
    assert same(next(iter(first)), whole[2])
    for other, words in (
        (stream(CONFIG, 4, **SMALL), "seed is 3 there and 4 here"),
        (made(batch=16), "batch is 8 there and 16 here"),
        (stream(PICTURES, 3, **SMALL), "task is .* there and null here"),
    ):
        with pytest.raises(InvalidInput, match=words):
            other.load_state_dict(first.state_dict())
        with pytest.raises(InvalidInput, match="has number, pass and made, got {'_num"):
            other.load_state_dict({"_num_yielded": 2})
    assert same(next(iter(stream(CollectConfig(**vars(CONFIG) | {"seed": 3}), **SMALL))), whole[0])


def test_windows_relabelling_and_own_rewards_reach_a_stream() -> None:
    batch = next(iter(made(window=Window(n_step=2, stack=2))))
    assert batch["observations"].shape == (8, 2, 600)
    own = made(reward=lambda episode, steps: np.full(int(episode["length"]), -0.5))
    rewards = next(iter(own))["rewards"]
    assert (rewards == -0.5).all()


def counted(**words: Any) -> Any:
    """A stream whose batches are their numbers."""
    data = made(**words)
    vars(data)["_batch_of"] = int
    return data


class Raced(np.ndarray[Any, Any]):
    """Memory of workers into which another one writes while it is read."""

    def __and__(self, other: Any) -> Any:
        read = np.asarray(self) & other
        SHARED[1] = 5 << 32 | 4
        return read


SHARED = np.array([4 << 32 | 3, 4 << 32 | 3])  # two workers have begun pass 2


def test_workers_that_begin_at_once_begin_the_same_pass() -> None:
    data, worker = made(batches=8), SimpleNamespace(id=0, num_workers=2, seed=5)
    data._begun = SHARED.view(Raced)
    assert data._next_pass(worker) == 3


STARTS = ("fork", "spawn", "forkserver")
# workers, how they start, persistent, ranks, resumed
CELLS = [
    *((0, None, False, ranks, resumed) for ranks in (1, 2) for resumed in (False, True)),
    *product((1, 2), STARTS, (False, True), (1, 2), (False, True)),
]
QUICK = [
    *CELLS[2:4],
    (2, "fork", False, 2, False),
    (2, "fork", True, 1, True),
    (2, "forkserver", True, 2, False),
    (1, "spawn", True, 1, False),
]
HAS_TORCH = find_spec("torch") is not None  # .ci/run's slow tests run where there is none, too


@pytest.mark.parametrize(
    ("workers", "start", "persistent", "ranks", "resumed"),
    [
        *(pytest.param(*cell, marks=pytest.mark.clients) for cell in QUICK),
        *(pytest.param(*cell, marks=pytest.mark.slow) for cell in CELLS * HAS_TORCH),
    ],
)
def test_passes_are_disjoint_complete_and_in_order(
    workers: int,
    start: str | None,
    persistent: bool,
    ranks: int,
    resumed: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch = pytest.importorskip("torch")
    loader_of = torch.utils.data.DataLoader
    if resumed:
        loader_of = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader
    multiprocessing.set_forkserver_preload(["knotgym.loaders.pytorch"])

    def loader() -> Any:
        data = counted(batches=8)
        words: dict[str, Any] = {"multiprocessing_context": start, "persistent_workers": persistent}
        return loader_of(data, batch_size=None, num_workers=workers, **words if workers else {})

    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: ranks)
    for rank in range(ranks):
        monkeypatch.setattr(torch.distributed, "get_rank", lambda rank=rank: rank)
        first = loader()
        assert len(first) == 8 // ranks
        right = [[*range(8 * k + rank, 8 * k + 8, ranks)] for k in range(5)]
        assert [*first] == right[0]
        # the next one isn't read to its end
        given = []
        for batch in first:
            given.append(batch)
            if len(given) == 3:
                state = first.state_dict() if resumed else None
                break
        assert given == right[1][:3]
        if resumed:
            first = loader()
            first.load_state_dict(state)
            assert [*first] == right[1][3:]
            ended = first.state_dict()
        for wanted in right[2:4]:
            assert [*first] == wanted
        if resumed:  # from the end of a pass
            first = loader()
            first.load_state_dict(ended)
            assert [*first] == right[2]


@pytest.mark.clients
def test_workers_read_a_stream_without_end_in_one_pass() -> None:
    torch = pytest.importorskip("torch")
    data = counted()
    loader = torch.utils.data.DataLoader(data, batch_size=None, num_workers=2)
    assert [*islice(data, 3)] == [0, 1, 2]
    held = data.state_dict()
    assert [*islice(loader, 3)] == [3, 4, 5]
    for refused in (lambda: next(iter(loader)), lambda: next(iter(data)), data.state_dict):
        with pytest.raises(InvalidInput, match="give passes a size"):
            refused()
    data.load_state_dict({name: held[name] for name in ("number", "made")})  # before passes
    assert [*islice(loader, 3)] == [3, 4, 5]
    with pytest.raises(InvalidInput, match="batches must be a whole number above 0, got 0"):
        made(batches=0)
