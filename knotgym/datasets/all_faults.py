"""Verification of all that a path or an id names, whatever its kind."""

from collections.abc import Iterator

from knotgym.datasets.episode_verification import Count, Replay, uncounted, verify_episodes
from knotgym.datasets.image_rows import Map, image_faults
from knotgym.datasets.located import Located
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.states import read_states


def faults(
    found: Located, replay: Replay, each: Map = map, count: Count = uncounted, sample: int = 0
) -> Iterator[str]:
    """Yield the faults of datasets, each as soon as it is found.

    Args:
        found: what a path or an id names.
        replay: plays episodes again.
        each: `map` or a pool's, for files of pictures; results keep the order.
        count: progress callback (stage, done, total).
        sample: how many drawn episodes of each dataset to play again; 0 for all.
    """
    if found.pictures:
        yield from image_faults(found.pictures, each, count)
    elif found.states and found.root.is_dir():
        yield from folder_faults(found.root, replay, count)
    elif found.states:
        yield from state_faults(read_states(found.states), count)
    for one in () if found.pictures or found.states else found.episodes:
        yield from verify_episodes(one, replay, count=count, sample=sample)
