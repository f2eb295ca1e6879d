"""What pictures a run makes of which states: quotas of each split, and what is held out.

Splits are by rope (test), by Gauss code (test-code) and by number of crossings (test-nx), see
`ImagesConfig`. All follows from the configuration and the states, before anything is pulled.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, Stream
from knotgym.generate.generate_config import ImagesConfig
from knotgym.rope import RopeConfig
from knotgym.states import States, families, held_form
from knotgym.topology import codes_of

Quota = tuple[str, int]  # split and nx
form_of = lru_cache(maxsize=2**16)(held_form)


class Plan(NamedTuple):
    """What is made of which states.

    Attributes:
        quota: (split, nx) -> number of pictures.
        held_out: codes, as `held_form` gives them, held out for split test-code.
        states: with at most as many crossings as are asked for.
        split: str (n,), the split of the ropes that start in each; "" for any, at plain loops.
    """

    quota: dict[Quota, int]
    held_out: frozenset[str]
    states: States
    split: NDArray[np.str_]


def plan_of(config: ImagesConfig, states: States) -> Plan:
    """Plan what is made of states; raise InvalidInput if such pictures can't be."""
    if unlike := RopeConfig().unlike(states.attributes.get("rope")):
        raise InvalidInput(f"the states were made with {unlike}")
    states = states.take(states.nx <= max(config.nx))
    if not len(states):
        raise InvalidInput(f"there is no state with at most {max(config.nx)} crossings")
    knots = sorted(set(states.knot.tolist()))
    quota, held_out = dict[Quota, int](), set[str]()
    each, more = divmod(config.count, len(config.nx))
    for index, nx in enumerate(config.nx):
        every = [str(code) for knot in knots for code in codes_of(knot, nx)]
        codes = {form_of(code, marked=config.marked) for code in every}
        if not codes:
            raise InvalidInput(f"no diagram of {' or '.join(knots)} has {nx} crossings")
        count = each + (index < more)
        if nx in config.held_nx:
            quota["test-nx", nx] = count
            continue
        new, test = 0, round(config.test_share * count)
        if len(codes) >= 4 and config.code_share > 0:
            new = round(config.code_share * count)
            order = Stream.IMAGE_CODES.generator(config.seed, nx).permutation(sorted(codes))
            held_out.update(order[: round(config.code_share * len(codes)) or 1].tolist())
        quota |= {("train", nx): count - test - new, ("test", nx): test, ("test-code", nx): new}
    quota = {key: count for key, count in quota.items() if count}
    return Plan(quota, frozenset(held_out), states, _splits_of(config, states, quota))


def _splits_of(
    config: ImagesConfig, states: States, quota: Mapping[Quota, int]
) -> NDArray[np.str_]:
    """Return the split of the ropes that start in each state, str (n,).

    Near-duplicates, up to mirror images, reversal and renumbering, are in one split. It is "" for
    plain loops: ropes that start there may be in any split.
    """
    family, split = families(states.points), np.full(len(states), "", dtype="<U9")
    most = {number: int(states.nx[family == number].max()) for number in set(family.tolist())}
    for nx in sorted(set(most.values())):
        same = [number for number in sorted(most) if most[number] == nx]
        order = Stream.IMAGE_FAMILIES.generator(config.seed, nx).permutation(len(same))
        test = round(config.test_share * len(same)) or int(config.test_share > 0)
        new = (round(config.code_share * len(same)) or 1) * (("test-code", nx) in quota)
        names = ["train", *["test"] * test, *["test-code"] * new, *["train"] * len(same)]
        for place, name in zip(order.tolist(), names, strict=False):
            split[family == same[place]] = "test-nx" if nx > max(config.trained) else name
    split[states.nx == 0] = ""
    return split
