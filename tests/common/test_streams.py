"""Random streams: no two purposes draw the same numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, _sequence

NUMBERS = st.integers(0, 2**63 - 1)
KEYS = st.tuples(st.sampled_from(Stream), NUMBERS, st.lists(NUMBERS, max_size=3))


@given(KEYS, KEYS)
def test_keys_are_of_one_width_and_differ_where_what_they_are_for_differs(
    one: tuple[Stream, int, list[int]], other: tuple[Stream, int, list[int]]
) -> None:
    first, second = (stream.key(seed, *counters) for stream, seed, counters in (one, other))
    assert len(first) == len(second) == 5
    states = [_sequence(key).generate_state(8).tolist() for key in (first, second)]
    assert (first == second) == (states[0] == states[1])


@pytest.mark.parametrize("wrong", [(-1,), (2**63,), (0, -1), (0, 1, 2, 3, 4)])
def test_a_seed_out_of_range_is_refused_in_one_line(wrong: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput) as caught:
        Stream.SPLIT.key(*wrong)
    assert len(str(caught.value).splitlines()) == 1


def test_a_derived_seed_is_held_exactly_by_json_and_float64() -> None:
    seed = Stream.EPISODE.derived_seed(3, 7)
    assert seed == int(float(seed)) < 2**52
