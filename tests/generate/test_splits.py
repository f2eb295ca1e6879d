"""States are dealt out to train and test, the states of each code as evenly as can be."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from knotgym.generate.drawing_source import _keep_duplicates_together, _split
from knotgym.states import read_states
from knotgym.topology import GaussCode, codes_of

EIGHT = list(codes_of("0_1", 2))


@given(st.lists(st.integers(0, 7), min_size=1, max_size=60), st.floats(0, 1), st.integers(0, 2**32))
def test_the_train_share_of_all_and_of_each_code_is_met_within_one_state(
    drawn: list[int], share: float, seed: int
) -> None:
    out = _split([EIGHT[k] for k in drawn], share, np.random.default_rng(seed))
    assert set(out) <= {"train", "test"} and abs((out == "train").sum() - share * len(drawn)) <= 1
    for kind, count in Counter(drawn).items():
        train = sum(one == "train" for one, k in zip(out, drawn, strict=True) if k == kind)
        assert abs(train - share * count) <= 1


def test_codes_with_chirality_are_split_as_the_code_they_show() -> None:
    both = [GaussCode((1, -1), "a"), GaussCode((1, -1), "c")] * 4
    assert Counter(_split(both, 0.5, np.random.default_rng(0))) == {"train": 4, "test": 4}


def test_near_duplicates_are_kept_in_one_split() -> None:
    some = read_states(images=False).points[40:44]
    points = np.concatenate([some, some[[1, 1]] + 0.01])
    assigned = np.array(["train", "test", "test", "train", "train", "test"])
    codes = [GaussCode()] * 3 + [GaussCode.parse("1+,1-")] * 3
    # the family goes to one split; of the others as many move as keep the sizes, if the nx allows
    dealt = _keep_duplicates_together(assigned, points, [GaussCode()] * 6)
    assert len(set(dealt[[1, 4, 5]])) == 1 and np.count_nonzero(dealt == "train") == 3
    dealt = _keep_duplicates_together(assigned, points, codes)
    assert len(set(dealt[[1, 4, 5]])) == 1 and dealt[0] == dealt[2] != dealt[1]
