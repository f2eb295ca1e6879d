"""What the readers of each kind of file give: faults, and digests of all that they take from it.

mutations.py asks it of damaged copies. Pictures are a Parquet shard; manifests, policies and
transcripts are a JSON file with what lies beside it in its folder; walks and
archives are HDF5 files beside the manifest that tells their checksum; transitions, settings, scores
and curves are a file alone, and so are models, of TorchScript. Checkpoints are in
checkpoint_readers.py.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from checkpoint_readers import CHECKPOINTS
from rich.console import Console
from told import Told, digest

_FAULTS: dict[str, list[str]] = {}


def told_states(path: Path) -> Told:
    """Faults of a state file, and digests of its columns."""
    from knotgym.datasets.state_verification import state_faults
    from knotgym.states.state_file import read_states

    states = read_states(path)
    given = {name: digest(own.tobytes()) for name, own in states.columns().items()}
    # faults are those of what was read, so states that were read alike have the same
    read = digest(repr((given, states.attributes, states.units, states.digest)))
    if read not in _FAULTS:
        _FAULTS[read] = list(state_faults(states))
    return _FAULTS[read], given


def told_episodes(path: Path) -> Told:
    """Faults of an episode file, and digests of its episodes and observations."""
    from knotgym.datasets.episode_reader import EpisodeReader
    from knotgym.datasets.episode_verification import show_episodes, verify_episodes

    faults = verify_episodes(path, frames=None, pyknotid=False, act_out=True)
    reader, given = EpisodeReader(path), {}
    show_episodes(path)
    labelled = reader.has("expert_action")
    given["told"] = digest(repr((labelled, reader.metadata(), reader.task, reader.versions)))
    for index in range(len(reader)):
        given[f"episode {index}"] = reader.episode(index).digest()
        seen = reader.observations(index) if reader.stored != "none" else {}
        seen = seen if isinstance(seen, dict) else {"": seen}
        for name, one in seen.items():
            given[f"observations {index} {name}"] = digest(np.ascontiguousarray(one).tobytes())
    return faults, given


def told_pictures(path: Path) -> Told:
    """Faults of a shard, and digests of its rows."""
    from knotgym.datasets.image_table import read_rows
    from knotgym.datasets.image_verification import image_faults

    faults = list(image_faults(path))
    rows = list(read_rows(path)) if not faults else []
    return faults, {str(k): digest(repr(row)) for k, row in enumerate(rows)}


def told_manifests(path: Path) -> Told:
    """Faults of a manifest; and what a merge, a run gone on with and `show` take from it."""
    from knotgym.cli.summaries import print_states
    from knotgym.datasets.manifest_check import listed_faults, read_manifest, report_faults
    from knotgym.generate.merge_shards import shard_folder_of
    from knotgym.runs.engine import request_of

    manifest, faults = read_manifest(path.parent)
    faults += [*report_faults(manifest), *listed_faults(path.parent, manifest)]
    request_of(path.parent)
    shard_folder_of(str(path.parent))
    states = path.with_name("states.h5")
    if states.is_file():
        shown = io.StringIO()
        print_states(str(path.parent), states, Console(file=shown))
        if not shown.getvalue().replace("\n", "").isprintable():
            raise AssertionError("control characters reach the terminal")
    # of the card and the gallery, which no reader reads, nobody misses the checksum
    read = {name: own for name, own in manifest.get("files", {}).items() if _is_read(name)}
    return faults, {"files": digest(json.dumps(read, sort_keys=True))}


def _is_read(name: str) -> bool:
    return Path(name).suffix not in (".md", ".png")


def told_policies(path: Path) -> Told:
    """Digests of all that was learned; whatever is wrong is an error."""
    from knotgym.learn.checkpoint import load_policy

    learned = load_policy(str(path.parent))
    arrays = {name: own.numpy() for name, own in learned.reader.state_dict().items()}
    arrays |= {"places": learned.starts}
    return [], {name: digest(own.tobytes()) for name, own in arrays.items()}


def told_transcripts(path: Path) -> Told:
    """What `show` prints of transcripts; their facts have no checksum."""
    from knotgym.cli.summaries import print_transcripts

    shown = io.StringIO()
    print_transcripts(path, Console(file=shown))
    if not shown.getvalue().replace("\n", "").isprintable():
        raise AssertionError("control characters reach the terminal")
    return [], {}


def told_walks(path: Path) -> Told:
    """Faults of walks beside a manifest, and digests of their columns."""
    from knotgym.datasets.walks_file import read_walks

    given = {name: digest(own.tobytes()) for name, own in vars(read_walks(path)).items()}
    return _listed(path), given


def told_archives(path: Path) -> Told:
    """Faults of an archive beside a manifest, and digests of what was found."""
    from knotgym.generate.states.archive import Archive

    archive = Archive.load(path)
    elites = [
        (niche.chiral, one.code.chiral, one.base_shift, one.reverse, one.objective)
        for niche, kept in archive.niches.items()
        for one in kept
    ]
    arrays = [
        own.tobytes()
        for kept in archive.niches.values()
        for one in kept
        for own in (one.sequence.beads, one.sequence.forces, one.state)
    ]
    counts = (archive.settings, archive.growth, archive.visits, vars(archive.transitions))
    given = {"elites": digest(repr(elites)), "arrays": digest(b"".join(arrays))}
    return _listed(path), {**given, "counts": digest(repr(counts))}


def told_transitions(path: Path) -> Told:
    """Digest of a file of transitions alone."""
    from knotgym.control.transition_counts import TransitionCounts

    return [], {"counts": digest(repr(vars(TransitionCounts.load(path))))}


def told_settings(path: Path) -> Told:
    """What --settings makes of a file that a user wrote; there is no checksum of it."""
    from knotgym.cli.options import read_settings
    from knotgym.common.configuration import from_json
    from knotgym.generate.states.generate_config import GenerateConfig

    from_json(GenerateConfig, read_settings(path))
    return [], {}


def told_scores(path: Path) -> Told:
    """What is told of evaluations; their numbers have no checksum."""
    from knotgym.generate.episodes.suite_scores import read_scores, score_tables

    shown = "".join(score_tables(read_scores([path])))
    if not shown.isprintable():
        raise AssertionError("control characters reach the terminal")
    return [], {}


def told_curves(path: Path) -> Told:
    """The type of the knot of a curve that a user made; there is no checksum of it."""
    from knotgym.generate.states.curves import start_of

    start_of(str(path))
    return [], {}


def told_models(path: Path) -> Told:
    """Whether a model can be used; there is no checksum of it."""
    import torch

    from knotgym.control.learned_policies import load_model

    torch.set_num_threads(1)  # others don't live through a fork
    load_model(path)(np.zeros((2, 600), np.float32))
    return [], {}


def _listed(path: Path) -> list[str]:
    """Faults of what the manifest beside a file lists, of which only that file is there."""
    from knotgym.datasets.manifest_check import listed_faults, read_manifest

    manifest, faults = read_manifest(path.parent)
    listed = {"files": {path.name: manifest["files"][path.name]}}
    return [*faults, *listed_faults(path.parent, listed)]


TOLD: dict[str, Callable[[Path], Told]] = {
    "states": told_states,
    "episodes": told_episodes,
    "pictures": told_pictures,
    "manifests": told_manifests,
    "policies": told_policies,
    "transcripts": told_transcripts,
    "walks": told_walks,
    "archives": told_archives,
    "transitions": told_transitions,
    "settings": told_settings,
    "scores": told_scores,
    "curves": told_curves,
    "models": told_models,
    **CHECKPOINTS,
}
