"""Formats that datasets can be exported to, by name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from knotgym.common.atomic_files import atomic_write, require_output, require_writable
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_dataset import open_episodes, write_episodes
from knotgym.datasets.episode_verification import Replay, expanded
from knotgym.datasets.located import (
    Sources,
    name_of,
    refuse_minaris_folder,
    require_apart_from,
    sources,
)
from knotgym.rope.curve_files import write_curves
from knotgym.states.state_file import read_states


def export(named: str, out: Path, form: str, replay: Replay, *, overwrite: bool = False) -> str:
    """Export a dataset to another format; return a one-line summary.

    Args:
        named: a path or an id.
        out: a file for one dataset in format compact or recording, and for curves; otherwise a
            folder.
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
    given = sources(named)
    require_apart_from(out, named)
    if form in _FILES:
        return _files(given, out, overwrite, form == "recording", replay)
    return _OTHERS[form](given, out, overwrite)


def _files(given: Sources, out: Path, overwrite: bool, recording: bool, replay: Replay) -> str:
    """Write packed files of episodes, without pictures; a folder of them for several datasets."""
    datasets = [open_episodes(path) for path in given.episodes]
    if not datasets:
        raise InvalidInput(f"{given.title} contains no trajectories")
    refuse_minaris_folder(out)
    several = len(datasets) > 1
    require_output(out, folder=several, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as target:
        if several:
            target.mkdir()
        for path, one in zip(given.episodes, datasets, strict=True):
            if recording:
                one = replace(one, episodes=one.episodes.recording())
            elif one.episodes.is_recording:
                one = expanded(one, replay)
            file = target / f"{name_of(path)}.h5" if several else target
            write_episodes(file, [one.episodes], one.task, one.facts, pack=True)
        files = sorted(target.iterdir()) if several else [target]
        size = sum(file.stat().st_size for file in files)
    episodes = sum(one.episodes.episodes.rows for one in datasets)
    return f"{episodes} episodes{f' in {len(datasets)} files' * several}, {size / 1e6:.1f} MB"


def _ogbench(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.ogbench_export import to_ogbench

    if len(given.episodes) != 1:
        raise InvalidInput(
            f"{given.title} has {len(given.episodes)} datasets; export them to ogbench one by one"
        )
    to_ogbench(given.episodes[0], out, overwrite=overwrite)
    return f"{open_episodes(given.episodes[0]).episodes.episodes.rows} episodes for ogbench"


def _huggingface(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.huggingface_export import to_huggingface

    to_huggingface(given, out, overwrite=overwrite)
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    return f"{size / 1e6:.1f} MB to upload"


def _minari(given: Sources, out: Path, overwrite: bool) -> str:
    from knotgym.datasets.exports.minari_export import to_minari

    if not given.episodes:
        raise InvalidInput(f"{given.title} contains no trajectories")
    to_minari(given.episodes, out, overwrite=overwrite)
    return f"a Minari root with {len(given.episodes)} datasets; upload the folder in it"


def _curves(given: Sources, out: Path, overwrite: bool) -> str:
    if given.states is None:
        raise InvalidInput(f"{given.title} holds no states, whose curves could be exported")
    points = read_states(given.states, images=False).points
    require_output(out, folder=False, overwrite=overwrite)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_curves(temporary, [f"state{row}" for row in range(len(points))], points)
    return f"{len(points)} curves"


_FILES = ("compact", "recording")  # one file, or a folder of them
_OTHERS: dict[str, Callable[[Sources, Path, bool], str]] = {
    "ogbench": _ogbench,
    "huggingface": _huggingface,
    "minari": _minari,
    "curves": _curves,
}
EXPORTERS = (*_FILES, *_OTHERS)
