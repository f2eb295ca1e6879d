"""Random streams: no two purposes draw the same numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, derived_seed, generator, key, words

from ..small_job import knotgym

NUMBERS = st.integers(0, 2**63 - 1)
KEYS = st.tuples(st.sampled_from(Stream), NUMBERS, st.lists(NUMBERS, max_size=3))


@given(KEYS, KEYS)
def test_keys_are_of_one_width_and_differ_where_what_they_are_for_differs(
    one: tuple[Stream, int, list[int]], other: tuple[Stream, int, list[int]]
) -> None:
    first, second = (key(stream, seed, *counters) for stream, seed, counters in (one, other))
    assert len(first) == len(second) == 5
    assert (first == second) == (words(first).tolist() == words(second).tolist())


def test_counters_that_are_not_named_do_not_make_another_purpose_draw_the_same() -> None:
    drawn = {
        generator(stream, seed, *counters).integers(2**62)
        for stream in Stream
        for seed in (0, 1, 5)
        for counters in ((), (1,), (0, 1), (0, 0, 1), (2**32,))
    }
    assert len(drawn) == len(Stream) * 3 * 5


@pytest.mark.parametrize("wrong", [(-1,), (2**63,), (0, -1), (0, 1, 2, 3, 4)])
def test_a_seed_out_of_range_is_refused_in_one_line(wrong: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput) as caught:
        key(Stream.SPLIT, *wrong)
    assert len(str(caught.value).splitlines()) == 1


def test_a_derived_seed_is_held_exactly_by_json_and_float64() -> None:
    seed = derived_seed(Stream.EPISODE, 3, 7)
    assert seed == int(float(seed)) < 2**52


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Record the entropy of every generator made from now on in this process."""
    seen: list[tuple[int, ...]] = []
    make: Callable[..., np.random.SeedSequence] = np.random.SeedSequence

    def recorded(entropy: Any = None, **keywords: Any) -> np.random.SeedSequence:
        seen.append(tuple(entropy))
        return make(entropy, **keywords)

    monkeypatch.setattr(np.random, "SeedSequence", recorded)
    return seen


@pytest.mark.slow  # the tests above show that different keys give different streams
def test_no_two_keys_of_a_run_are_equal_but_those_that_are_asked_for_again(
    used: list[tuple[int, ...]], tmp_path: Path
) -> None:
    common = ("--workers", 1, "--quiet", "--seed", 7)
    folders = [tmp_path / name for name in ("states", "episodes", "images")]
    for words_of in (
        ("generate", "--nx", 1, "--count", 1, "--out", folders[0]),
        ("collect", "--task", "tie", "--nx", 1, "--policy", "scripted", "--episodes", 3)
        + ("--set", "task.horizon=4", "--out", folders[1]),
        ("images", "--nx", 1, "--count", 2, "--out", folders[2]),
    ):
        assert knotgym(*words_of, *common) == 0
    assert len(used) > 30 and {len(entropy) for entropy in used} == {10}
    drawn = {tuple(np.random.default_rng(key).integers(2**62, size=2)) for key in set(used)}
    assert len(drawn) == len(set(used))
    again = {Stream(entropy[0]) for entropy in used if used.count(entropy) > 1}
    assert again <= {Stream.CODE_ORDER, Stream.CODE_ORDER, Stream.EPISODE, Stream.SPLIT}
