"""Formats that datasets can be exported to, by name."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from knotgym.common import InvalidInput, atomic_write, require_apart, require_output
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
    given = locate_own(named)
    require_apart(out, [given.root])
    is_file = form in _FILES and len(given.episodes) < 2
    if form in _FILES:
        refuse_minaris_folder(out)
    if form != "ogbench":
        require_output(out, folder=not is_file, overwrite=overwrite)
    needs = "episodes" if form in _OF_EPISODES else "pictures" if form in _OF_PICTURES else ""
    if needs and not getattr(given, needs):
        raise InvalidInput(f"{given.title} contains no {needs}")
    if form == "ogbench":  # its files lie beside those of other datasets
        return to_ogbench(given, out, overwrite)
    with atomic_write(out, overwrite=overwrite) as target:
        if not is_file:
            target.mkdir()
        write = _FOLDERS.get(form) or partial(_write_files, form=form, replay=replay)
        return write(given, target)


def _write_files(given: Located, target: Path, form: str, replay: Replay) -> str:
    """Write a file of episodes without pictures, or several into a folder."""
    datasets, size = [open_episodes(path) for path in given.episodes], 0
    for path, one in zip(given.episodes, datasets, strict=True):
        kept = {name: one.attributes[name] for name in {"expansion"} & one.attributes.keys()}
        if form == "recording":
            one = replace(one, episodes=one.episodes.recording())
        elif one.episodes.is_recording:
            one = expanded(one, replay)
        # named by the end of its id, such as tie-nx3-demonstrations-v0
        name = f"{'-'.join(path.with_suffix('').parts[-2:])}.h5"
        file, facts = target / name if target.is_dir() else target, {**one.facts, **kept}
        write_episodes(file, [one.episodes], one.task, facts, pack=form != "columns")
        size += file.stat().st_size
    episodes = sum(one.episodes.episodes.rows for one in datasets)
    files = f" in {len(datasets)} files" if target.is_dir() else ""
    return f"{episodes} episodes{files}, {size / 1e6:.1f} MB"


_FILES = ("compact", "columns", "recording")  # one file, or a folder of them
_FOLDERS: dict[str, Callable[[Located, Path], str]] = {
    "huggingface": to_huggingface,
    "minari": to_minari,
    "coco": to_coco,
    "webdataset": to_webdataset,
}
_OF_EPISODES, _OF_PICTURES = (*_FILES, "ogbench", "minari"), ("coco", "webdataset")
EXPORTERS = (*_FILES, "ogbench", *_FOLDERS)
