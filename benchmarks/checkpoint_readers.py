"""What runs gone on with take from what was saved: as file_readers.py, of each kind of checkpoint.

Searches and random walks are the JSON file of a staging folder with what lies beside and
below it; episode files that of a shard, walk files one of pictures, trainings the arrays beside
their request, replies the lines of a prompted run, caches the file of a frame cache
beside the episode file that they are of.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from told import Told, digest

_ASKED: dict[str, Any] = {}  # kind -> request of the sound file, which is read first


def _asked(kind: str, here: Any) -> Any:
    return _ASKED.setdefault(kind, here)


def told_staging(kind: str, path: Path) -> Told:
    """Digests of what a run of states takes up from its staging folder."""
    from knotgym.common.configuration import from_json
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.random_walk import RandomWalkConfig
    from knotgym.generate.states.random_walk_recipe import RandomWalkRecipe
    from knotgym.generate.states.state_recipe import StateRecipe
    from knotgym.runs.engine import request_of, require_resumable

    folder = path.parent
    left = request_of(folder)
    asked = _asked(kind, left)
    recipe: Any
    if kind == "random_walks":
        recipe = RandomWalkRecipe(from_json(RandomWalkConfig, asked["config"]))
    else:
        recipe = StateRecipe(from_json(GenerateConfig, asked["config"]))
    require_resumable(folder, left, asked, recipe.flexible)
    if not recipe.load(folder):
        return ["there is nothing to go on from, so the run begins anew"], {}
    skipped = ("archive", "codes", "config", "shard")
    counts = {name: own for name, own in vars(recipe).items() if name not in skipped}
    with np.printoptions(threshold=10**9, floatmode="unique"):
        return [], {name: digest(repr(own)) for name, own in counts.items()}


def told_episode_files(path: Path) -> Told:
    """What a collection counts of a file of episodes; one that is spoilt is played anew."""
    from knotgym.generate.episodes.collect import _finished

    tally = _finished(path.with_suffix(".h5"))
    return ([], {"tally": digest(repr(tally))}) if tally else (["it is played anew"], {})


def told_walk_files(path: Path) -> Told:
    """Digests of the walks of a unit; whatever is wrong is an error, and they are made anew."""
    from knotgym.generate.images.unit_files import load_frames

    frames = vars(load_frames(path))
    return [], {
        name: digest(own.tobytes() if isinstance(own, np.ndarray) else repr(own))
        for name, own in frames.items()
    }


def told_trainings(path: Path) -> Told:
    """Digests of the arrays that a training goes on from."""
    from knotgym.learn.training import REQUEST, begin_training

    beside = path.with_name(REQUEST)
    asked = _asked(
        "trainings", json.loads(beside.read_text()) if "trainings" not in _ASKED else None
    )
    kept, _ = begin_training(path.parent, asked)
    if not kept:
        return ["there is nothing to go on from, so the training begins anew"], {}
    return [], {name: digest(own.numpy().tobytes()) for name, own in kept.items()}


def told_replies(path: Path) -> Told:
    """Digests of the replies that a prompted run asks no more for; what is lost it asks again."""
    from knotgym.prompting.kept_replies import KeptReplies

    kept = KeptReplies(path)
    kept.close()
    given = {str(at): digest(repr(reply)) for at, reply in kept._kept.items()}
    whole = _asked("replies", given)
    again = [f"{at} is asked again" for at in whole if at not in given]
    return again, {**whole, **given}


def told_caches(path: Path) -> Told:
    """Digests of the pictures that a loader takes from a cache, which makes spoilt ones anew."""
    from knotgym.datasets.episode_reader import EpisodeReader
    from knotgym.loaders.frame_cache import CachedFrames, FrameCache, _key

    reader = EpisodeReader(path.parent / "main_data.hdf5")
    folder = path.parent / "cache"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if os.path.lexists(path):
        path.rename(folder / f"{_key(reader, None)}.frames")
    frames = CachedFrames(reader, None, FrameCache(folder))
    return [], {"frames": digest(frames.frames.tobytes())}


CHECKPOINTS: dict[str, Callable[[Path], Told]] = {
    **{kind: partial(told_staging, kind) for kind in ("searches", "random_walks")},
    "episode_files": told_episode_files,
    "walk_files": told_walk_files,
    "trainings": told_trainings,
    "replies": told_replies,
    "caches": told_caches,
}
