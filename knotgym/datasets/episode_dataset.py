"""Files of episodes: a Minari dataset's `episodes.h5`, or a single file of any name.

    {root}/{dataset id}/data/episodes.h5        the episodes, which every reader of ours reads
    {root}/{dataset id}/data/main_data.hdf5     the same for Minari, see `minari_form`
    {root}/{dataset id}/data/metadata.json      Minari's metadata
    {root}/{dataset id}/data/states.h5          the states it resets from, unless they are shipped

An episode file holds the tables of `episodes`, in one of two forms. An *entry* is a recording with
a protocol and claims: every pull of an evaluation. The attributes are:

    form        "columns" or "recording", whose `start_qpos` is zeros where the seed draws it, and
                whose forces are whole numbers where all are `quantized`
    task        settings of the environment
    tasks       those that the column `setup` counts, in files that have it; `task` joins them
    rope        fingerprint of the rope model
    engine      digest of what the engine does, see `rope.ENGINES`; left out where nobody knows
    versions    package -> version that wrote the file
    digest      SHA-256 of starts and pulls, the same in both forms
    given       column that nothing can make again -> its SHA-256
    expansion   SHA-256 of the columns that a replay gives; a recording has it from the columns that
                it was made of
    attributes  SHA-256 of all other attributes
    protocol    of an entry, what was played; see `knotgym.generate.entries`
    claims      of an entry, what no replay proves
    metadata    of the Minari dataset, see `MinariMetadata`; left out in single files
    run         facts about the run that made it, such as its configuration; may be left out
    selection   the selections that it went through, oldest first; may be left out
    states_sha256   of the state file that `task` resets from, unless it is bundled
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym import common, envs  # OpenCV and the engines, which few need, on first use
from knotgym.common import InvalidFile, InvalidInput, KnotgymError, MissingFile, Stream, Table
from knotgym.datasets.episodes import EPISODES, STEPS, STORED_PULLS, STORED_ROWS, Episodes, fitted
from knotgym.envs import TaskConfig
from knotgym.rope import ENGINES
from knotgym.states import is_bundled, minari_root, resolve, resolve_states

FORMAT, VERSION = "knotgym-episodes", 3
FILE = "episodes.h5"
_LISTED = 5  # datasets that a message names
MAIN = "main_data.hdf5"  # Minari's
STATES_FILE, STATES_DIGEST = "states.h5", "states_sha256"  # in the same folder; its attribute
_KEPT_FACTS = ("metadata", "run", "selection", "tasks", "engine", STATES_DIGEST)
_SEAL = "attributes"


def _to_3(items: dict[str, Any], attributes: dict[str, Any]) -> None:
    """Upgrade a file of version 2, in which one column alone was a claim, `expert_action`."""
    advice = attributes.pop("advice", None)
    attributes["given"] = {"steps/expert_action": advice} if advice else {}
    attributes[_SEAL] = EpisodeDataset.seal(attributes)


_UPGRADES = {2: _to_3}
_FORMS = {"columns": (EPISODES, STEPS), "recording": (STORED_ROWS, STORED_PULLS)}


@dataclass(frozen=True)
class EpisodeDataset:
    """An opened file of episodes.

    Attributes:
        path: of the file.
        episodes: its episodes, mapped into memory where the file isn't packed.
        task: the environment.
        attributes: attributes of the file.
        rows: int64 (n,), which of the file's episodes these are; None for all.
        parts: the datasets that were joined to this one, which is in memory; none if it is a file.

    Pickling one keeps the paths alone: each process maps the files itself.
    """

    FORMAT: ClassVar[str] = FORMAT

    path: Path
    episodes: Episodes
    task: TaskConfig
    attributes: Mapping[str, Any]
    rows: NDArray[np.int64] | None = None
    parts: "tuple[EpisodeDataset, ...]" = ()

    def __reduce__(self) -> Any:
        return _opened, (self.parts or self.path, self.rows)

    @property
    def metadata(self) -> dict[str, Any] | None:
        """The Minari metadata of the dataset that the file belongs to or came from, if any."""
        stored = self.attributes.get("metadata")
        return stored if isinstance(stored, dict) else None

    @property
    def name(self) -> str:
        """The dataset id, or else the name of the file, without control characters."""
        return common.one_line(str((self.metadata or {}).get("dataset_id", self.path.name)))

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The attributes that stay when rows are taken: run, selection, states, engine, ..."""
        known = {k: self.attributes[k] for k in _KEPT_FACTS if k in self.attributes}
        return {"engine": None, **known}  # whose engine nobody knows isn't of today's

    @property
    def digests(self) -> dict[str, Any]:
        """The digests of its episodes as they are, by the names of the file's attributes."""
        return _digests_of([self.episodes])

    @staticmethod
    def seal(attributes: Mapping[str, Any]) -> str:
        """Return the digest of a file's attributes, but for this one, as they are stored."""
        sealed = {
            name: str(value) if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for name, value in sorted(attributes.items())
            if name != _SEAL
        }
        return hashlib.sha256(json.dumps(sealed).encode()).hexdigest()

    def digest_faults(self) -> Iterator[str]:
        """Yield what of a file isn't as it was written, of what no replay gives."""
        if self.rows is not None or self.parts:
            return  # a part of a file has no digest
        now, then = self.digests, self.attributes
        if then.get("attributes") != self.seal(then):
            yield f"{self.path}: its attributes don't match their digest"
        if then.get("digest") != now["digest"]:
            yield f"{self.path}: its starts and pulls don't match their digest"
        if not isinstance(claims := then.get("given"), dict):
            yield f"{self.path} has no digests of columns that nothing can make again"
            return
        for name in sorted({*now["given"], *claims}):
            if claims.get(name) != now["given"].get(name):
                yield f"{self.path}: column {name} doesn't match its digest"

    def __len__(self) -> int:
        """Return the number of episodes."""
        return self.episodes.episodes.rows

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The numbers of the episodes in their file, int64 (n,)."""
        return np.arange(len(self)) if self.rows is None else self.rows

    def select(self, rows: Any) -> "EpisodeDataset":
        """Return the dataset with some of its episodes, by a mask or by their numbers."""
        chosen = self.numbers[np.asarray(rows) if np.size(rows) else slice(0)]
        return replace(self, episodes=self.episodes.select(rows), rows=chosen)

    def frames(self, observer: "envs.Observer") -> "envs.Frames":
        """Return its states, row by row, and its episodes' goals, for observations of them."""
        rows, steps = self.episodes
        episode_of = np.append(self.episodes.episode_of(), np.arange(rows.rows))

        @cache
        def _looks() -> Any:
            goals = zip(rows["goal"].tolist(), rows["goal_points"], strict=True)
            return observer.appearances(goals)

        def _draw(ids: NDArray[np.int64]) -> NDArray[np.uint8]:
            points = frames.points(ids).astype(np.float64)
            return observer.draw_ropes(points, [_looks()[k] for k in episode_of[ids]])

        stored = steps["observation"], steps["visits"], rows["goal_points"], rows["goal_visits"]
        frames = envs.Frames(*stored, _draw, common.Threads())
        return frames

    def seen(self, observation: str | None = None, *, alone: bool = False) -> Any:
        """Observe each state as the environment does: an array (rows, ...), or a dict of several.

        Args:
            observation: the kind; None for that of its task.
            alone: without the goals.
        """
        rows = np.arange(self.episodes.steps.rows)
        kind = envs.OBSERVATIONS[observation or self.task.observation]
        frames = self.frames(envs.Observer(self.task))
        if alone:
            return kind.halves(frames, rows)
        goals = len(rows) + self.episodes.episode_of()
        return kind.observe(self.task, frames, rows, goals)

    def drawn(self, sample: int) -> "EpisodeDataset":
        """Return so many episodes, drawn from a generator of their content; 0 for all."""
        if not 0 < sample < len(self):
            return self
        content = int(self.digests["digest"][:12], 16)
        rng = Stream.CHECKED_EPISODES.generator(content)
        return self.select(np.sort(rng.choice(len(self), sample, replace=False)))

    @cached_property
    def tasks(self) -> list[TaskConfig]:
        """The tasks that `setup` counts; the task alone where there is no such column."""
        listed = self.attributes.get("tasks")
        return [common.from_json(TaskConfig, task) for task in listed] if listed else [self.task]

    def setups(self) -> "Iterator[tuple[NDArray[np.int64], EpisodeDataset]]":
        """Yield the rows of the episodes of each task, and these as a dataset of that task."""
        if "setup" not in self.episodes.episodes:
            yield np.arange(len(self)), self
            return
        rest = {name: value for name, value in self.attributes.items() if name != "tasks"}
        for number, task in enumerate(self.tasks):
            rows = np.flatnonzero(self.episodes.episodes["setup"] == number)
            yield rows, replace(self, task=task, attributes=rest).select(rows)

    @property
    def found_task(self) -> TaskConfig:
        """The task with the path of its states, so that its environment can be made."""
        task = self.task
        return task if is_bundled(task.states) else replace(task, states=str(self.states_path()))

    def states_path(self) -> Path:
        """Return the state file that the episodes were reset from, found by its digest.

        It lies beside the episodes as `states.h5`, or in the dataset in Minari's folder whose id
        the task names. A path in a file leads nowhere: a stranger may have written it.

        Raises:
            MissingFile: it lies in neither place.
            InvalidFile: the file found there is another one, or the episodes name no digest.
        """
        named, digest = self.task.states, self.attributes.get(STATES_DIGEST)
        if is_bundled(named) or named is None:
            return resolve_states(named)
        if not isinstance(digest, str):
            raise InvalidFile(f"{self.path} doesn't say by SHA-256 which states it was reset from")
        root = minari_root().resolve()
        carried = (root / named / "data" / STATES_FILE).resolve()
        candidates = [self.path.with_name(STATES_FILE), *[carried] * carried.is_relative_to(root)]
        candidates = [path for path in candidates if path.is_file() and not path.is_symlink()]
        for path in candidates:
            if common.sha256(path) == digest:
                return path
        if candidates:
            raise InvalidFile(
                f"{candidates[0]} isn't the state file that {self.path} was reset from: its SHA-256"
                f" should be {digest}"
            )
        raise MissingFile(
            f"{self.path} was reset from states that aren't here: put the state file with SHA-256"
            f" {digest} beside it as {STATES_FILE}"
        )


def open_episodes(source: Any) -> EpisodeDataset:
    """Open a file of episodes or a dataset; reading it maps the columns, and copies nothing.

    Args:
        source: as for `episode_file`, or a dataset that is open already. A `minari.MinariDataset`
            gives its own episodes alone.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: it is damaged, or wasn't written by knotgym.
    """
    if isinstance(source, EpisodeDataset):
        return source
    path = episode_file(source)
    if path.name == MAIN:
        raise InvalidFile(f"{path} was recorded by Minari: it can be loaded, but not played again")
    read = partial(common.read_tables, format=FORMAT, version=VERSION, upgrades=_UPGRADES)
    _, attributes = read(path)
    if (form := str(attributes.get("form"))) not in _FORMS:
        raise InvalidFile(f"{path} has form {attributes.get('form')!r}, not {', '.join(_FORMS)}")
    with InvalidFile.instead(f"{path} has no valid task", KnotgymError, KeyError, TypeError):
        task = common.from_json(TaskConfig, attributes["task"])
    (rows, steps), _ = read(path, *(schema.sized(beads=task.beads) for schema in _FORMS[form]))
    lengths = rows["length"]
    is_longer = lengths.max(initial=-1) >= steps.rows  # so that no sum overflows
    if is_longer or int(lengths.sum()) + rows.rows != steps.rows:
        raise InvalidFile(f"{path} has {steps.rows} rows of steps, not those of its episodes")
    opened = EpisodeDataset(path, Episodes(rows, steps), task, attributes)
    if "setup" in rows or "tasks" in attributes:
        with InvalidFile.instead(f"{path} has no valid tasks", KnotgymError, KeyError, TypeError):
            if rows["setup"].max(initial=0) >= len(opened.tasks):
                raise InvalidFile("its episodes are of more tasks than it lists")
    if opened.episodes.is_recording:
        from knotgym.datasets.stored_recordings import unpacked  # here, as few need it

        opened = unpacked(opened)
    return _chosen(opened, source)


def _chosen(opened: EpisodeDataset, source: Any) -> EpisodeDataset:
    """Return the episodes that a `minari.MinariDataset` has; all of those of another source."""
    chosen = getattr(source, "episode_indices", None)
    return opened if chosen is None else opened.select(chosen)


def _opened(source: Any, rows: NDArray[np.int64] | None) -> EpisodeDataset:
    opened = columns_of(source, recordings=True)
    return opened if rows is None else opened.select(rows)


def columns_of(source: Any, *, recordings: bool = False) -> EpisodeDataset:
    """Open a dataset as `open_episodes` does, and refuse a recording unless `recordings` are taken.

    A dataset that Minari's `DataCollector` recorded is read into memory, see `minari_recording`. A
    list of datasets is read into memory as one, which has the first one's task. They may be of
    different tasks, crossing numbers, splits, states and engines, but not of different ropes.

    Raises:
        InvalidInput: it is a recording, whose states must be simulated first; or datasets of a list
            can't be loaded together.
    """
    if isinstance(source, (list, tuple)):
        parts = tuple(columns_of(each) for each in source)
        require_alike(parts, lambda part: common.Mark.values(part.task, "read", "look"))
        path = Path(" and ".join(str(part.path) for part in parts))
        every = Episodes.merged([part.episodes for part in parts])
        return EpisodeDataset(path, every, parts[0].task, {}, parts=parts)
    if not isinstance(source, EpisodeDataset) and (path := episode_file(source)).name == MAIN:
        from knotgym.datasets.minari_recording import recorded_columns  # here, as few need it

        return _chosen(EpisodeDataset(path, *recorded_columns(path), {}), source)
    opened = open_episodes(source)
    if opened.episodes.is_recording and not recordings:
        raise InvalidInput(f"{opened.path} is a recording; dataset export --to columns plays it")
    return opened


def require_alike(
    datasets: Sequence[EpisodeDataset], facts: Callable[[EpisodeDataset], Mapping[str, object]]
) -> None:
    """Raise InvalidInput if datasets differ in one of their facts."""
    first = facts(datasets[0])
    for other in datasets[1:]:
        for name, value in facts(other).items():
            if value != first[name]:
                raise InvalidInput(
                    f"these datasets must have one {name}: {datasets[0].path} has {first[name]},"
                    f" {other.path} has {value}"
                )


def write_episodes(
    path: str | os.PathLike[str],
    parts: Sequence[Episodes],
    task: TaskConfig | Sequence[TaskConfig],
    facts: Mapping[str, Any] | None = None,
    *,
    pack: bool = False,
) -> None:
    """Write episodes to one file atomically; it is replaced if it exists.

    Args:
        path: of the file.
        parts: sets of episodes, which are appended; all recordings, or none.
        task: the environment; or several, which the column `setup` counts.
        facts: further attributes: metadata, run, selection, and the digests of the task's states
            and of the engine, which are found here if they aren't given. None is left out.
        pack: whether to compress the file, which then isn't mapped when read; recordings always
            are.

    Raises:
        InvalidInput: there are no parts, or they differ in form or columns.
    """
    if not parts or len({part.is_recording for part in parts}) > 1:
        raise InvalidInput("episodes to write are a list of recordings, or of columns")
    parts, extra = fitted(parts), dict(facts or {})
    if not isinstance(task, TaskConfig):
        extra["tasks"] = [common.as_json(each) for each in task]
        task = TaskConfig.joined(task)
    if not is_bundled(task.states) and STATES_DIGEST not in extra:
        extra[STATES_DIGEST] = common.sha256(resolve_states(task.states))
    if "engine" not in extra:
        extra["engine"] = ENGINES[task.engine].behaviour()
    attributes = {
        **{name: fact for name, fact in extra.items() if fact is not None},
        "form": "recording" if parts[0].is_recording else "columns",
        "task": common.as_json(task),
        "rope": task.rope_config.fingerprint,
        "versions": {"knotgym": knotgym.__version__, "mujoco": version("mujoco")},
        **_digests_of(parts),
    }
    attributes[_SEAL] = EpisodeDataset.seal(attributes)
    if parts[0].is_recording:
        from knotgym.datasets.stored_recordings import packed  # here, as above

        # beside its states, by which the starts that follow from seeds are found
        parts, pack = packed(parts, EpisodeDataset(Path(path), parts[0], task, attributes)), True
    tables = zip(*parts, strict=True)
    common.write_tables(path, tables, attributes, format=FORMAT, version=VERSION, pack=pack)


def _digests_of(parts: Sequence[Episodes]) -> dict[str, Any]:
    """Hash sets of episodes as one; return the digests by the names of the file's attributes."""
    parts = fitted(parts)
    claims = zip(*(part.claims().items() for part in parts), strict=True)
    digests: dict[str, Any] = {"digest": _digest([part.core() for part in parts])}
    digests["given"] = {pairs[0][0]: Table.digest(*(part for _, part in pairs)) for pairs in claims}
    if not any(part.is_recording for part in parts):
        digests["expansion"] = _digest([part.replayed() for part in parts])
    return digests


def _digest(parts: Sequence[Episodes]) -> str:
    """Hash columns (SHA-256, hexadecimal)."""
    digests = "".join(Table.digest(*tables) for tables in zip(*parts, strict=True))
    return hashlib.sha256(digests.encode()).hexdigest()


def episode_file(source: Any) -> Path:
    """Find the file of episodes of a dataset.

    Args:
        source: the file, a dataset's folder or the `data` folder in it, the folder of a run of
            `generate` (its demonstrations of the train split), any folder that holds one dataset, a
            `minari.MinariDataset`, or an id that Minari would find.

    Raises:
        InvalidInput: the source is nothing of these.
        MissingFile: there is no such file.
        InvalidFile: a run has demonstrations of several crossing numbers, or the file is a link.
    """
    if hasattr(source, "storage"):
        source = source.storage.data_path
    if not isinstance(source, (str, os.PathLike)):
        raise InvalidInput(f"a dataset is an id, a folder or a file, got {source!r}")
    root, file = resolve(source), resolve(source, FILE, MAIN)
    if file.is_file():
        return file
    files = sorted((root / "minari").glob(f"knotgym/*/demonstrations-v0/data/{FILE}"))
    files = files or [folder / "data" / FILE for folder in datasets_below(root)]
    if len(files) > 1:
        listed = ", ".join(str(path.parents[1]) for path in files[:_LISTED])
        more = f" and {len(files) - _LISTED} more" if len(files) > _LISTED else ""
        raise InvalidFile(f"{root} holds several datasets; choose one of them: {listed}{more}")
    if not files:
        arrow = "; it is in Minari's format arrow: record it with data_format='hdf5'"
        is_arrow = any(root.glob("data/0/*.arrow"))
        raise MissingFile(f"no episodes at {root}{arrow * is_arrow}")
    common.require_no_links(root, files)
    return files[0]


def datasets_below(folder: Path) -> tuple[Path, ...]:
    """Return the folders of the datasets that a folder is or holds, at any depth."""
    if any((place / FILE).is_file() for place in (folder, folder / "data")):
        return (folder,)
    return tuple(file.parents[1] for file in sorted(folder.glob(f"**/data/{FILE}")))
