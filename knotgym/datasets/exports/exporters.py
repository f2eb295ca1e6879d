"""Formats that datasets can be exported to, by name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from knotgym.common.atomic_files import (
    atomic_write,
    require_apart,
    require_output,
    require_writable,
)
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_dataset import open_episodes, write_episodes
from knotgym.datasets.episode_verification import Replay, expanded
from knotgym.datasets.exports.huggingface_export import to_huggingface
from knotgym.datasets.exports.minari_export import to_minari
from knotgym.datasets.exports.ogbench_export import to_ogbench
from knotgym.datasets.exports.picture_exports import to_coco, to_webdataset
from knotgym.datasets.located import Located, locate_own, refuse_minaris_folder


def export(named: str, out: Path, form: str, replay: Replay, *, overwrite: bool = False) -> str:
    """Export a dataset to another format; return a one-line summary.

    Args:
        named: a path or an id.
        out: a file for one dataset in a format of _FILES; otherwise a folder.
        form: the format, one of EXPORTERS.
        replay: plays recordings again, `control.verification.replay`.
        overwrite: replace what is there.

    Raises:
        InvalidInput: there is no such format, or it has no place for this kind of dataset.
        Occupied: the output exists, and `overwrite` is False.
    """
    if form not in EXPORTERS:
        raise InvalidInput(f"no format {form!r}; formats are {', '.join(EXPORTERS)}")
    require_writable(out)
    given = locate_own(named)
    require_apart(out, [given.root])
    if form in _OF_EPISODES and not given.episodes:
        raise InvalidInput(f"{given.title} contains no trajectories")
    if form in _FILES:
        return _files(given, out, overwrite, form, replay)
    return _OTHERS[form](given, out, overwrite)


def _files(given: Located, out: Path, overwrite: bool, form: str, replay: Replay) -> str:
    """Write files of episodes, without pictures; a folder of them for several datasets."""
    datasets = [open_episodes(path) for path in given.episodes]
    refuse_minaris_folder(out)
    several = len(datasets) > 1
    require_output(out, folder=several, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as target:
        if several:
            target.mkdir()
        for path, one in zip(given.episodes, datasets, strict=True):
            kept = {name: one.attributes[name] for name in {"expansion"} & one.attributes.keys()}
            if form == "recording":
                one = replace(one, episodes=one.episodes.recording())
            elif one.episodes.is_recording:
                one = expanded(one, replay)
            # named by the end of its id, such as tie-nx3-demonstrations-v0
            file = target / f"{'-'.join(path.with_suffix('').parts[-2:])}.h5" if several else target
            write_episodes(
                file, [one.episodes], one.task, {**one.facts, **kept}, pack=form != "columns"
            )
        files = sorted(target.iterdir()) if several else [target]
        size = sum(file.stat().st_size for file in files)
    episodes = sum(one.episodes.episodes.rows for one in datasets)
    return f"{episodes} episodes{f' in {len(datasets)} files' * several}, {size / 1e6:.1f} MB"


_FILES = ("compact", "columns", "recording")  # one file, or a folder of them
_OF_EPISODES = (*_FILES, "ogbench", "minari")
_OTHERS: dict[str, Callable[[Located, Path, bool], str]] = {
    "ogbench": to_ogbench,
    "huggingface": to_huggingface,
    "minari": to_minari,
    "coco": to_coco,
    "webdataset": to_webdataset,
}
EXPORTERS = (*_FILES, *_OTHERS)
