"""Verification of all that a path or an id names, whatever its kind."""

from collections.abc import Iterator
from functools import partial
from itertools import chain

from knotgym.datasets.episode_verification import Replay, ReplayFault, verify_episodes
from knotgym.datasets.image_rows import Map, image_faults
from knotgym.datasets.located import Located
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.states import read_states


def faults(found: Located, replay: Replay, each: Map = map, sample: int = 0) -> Iterator[str]:
    """Yield the faults of datasets, each as soon as it is found.

    If only replays differ, a last line says that machines round differently.

    Args:
        found: what a path or an id names.
        replay: plays episodes again.
        each: `map` or a pool's, for files of pictures; results keep the order.
        sample: how many drawn episodes of each dataset to play again; 0 for all.
    """
    if found.pictures:
        own = image_faults(found.pictures, each)
    elif found.states and found.root.is_dir():
        own = folder_faults(found.root, replay)
    elif found.states:
        own = state_faults(read_states(found.states))
    else:
        verified = partial(verify_episodes, replay=replay, sample=sample)
        own = chain.from_iterable(map(verified, found.episodes))
    kinds = set[type]()
    for fault in own:
        kinds.add(type(fault))
        yield fault
    if kinds == {ReplayFault}:
        yield (
            f"{found.root}: only replays differ, and other machines may round differently; the"
            " manifest says which made it"
        )
