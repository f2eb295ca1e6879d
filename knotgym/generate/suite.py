"""The fixed benchmark: a few policies' episodes on nine setups, two splits and two sets of states.

    {out}/knotgym/{task}-nx{nx}/{policy}-v0                         readable states, split by state
    {out}/knotgym/{task}-nx{nx}/{policy}-random-walk-v0             random-walk states
    {out}/knotgym/{task}-nx{nx}/{policy}-train-code[-...]-v0        split by code
    {out}/knotgym/suite.json, README.md                             what is known of each; the card

Every dataset is an ordinary collection, see `collect`, or its pulls come from a recording that
ships. This module makes them one after the other, and one card for all.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import knotgym
from knotgym import common
from knotgym.common import Failed, InvalidFile, InvalidInput, KnotgymError, one_line, require_output
from knotgym.control import PolicyConfig, replay
from knotgym.datasets import EpisodeDataset, MinariMetadata, expanded, open_episodes, suite_card
from knotgym.generate.collection import collect, recording_at, require_collectable, run_facts
from knotgym.generate.episode_configs import BENCH, SIZES, CollectConfig, SuiteConfig
from knotgym.generate.results import reference_scores
from knotgym.rope import ENGINES
from knotgym.runs import Progress, RunOptions
from knotgym.states import minari_root

_FORMAT = "knotgym-suite"
_CARD = ("suite.json", "README.md")
_RECORDINGS = Path(str(files("knotgym.generate") / "data" / "recordings"))  # that ship
_DIGESTS = Path(str(files("knotgym.generate") / "data" / "digests.json"))
_DRAWN = 8  # episodes of a finished set that are played again


def make_suite(
    config: SuiteConfig, out: Path | None, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make the missing datasets and a card for all existing ones; return the card's folder.

    Args:
        config: which datasets.
        out: Minari root to write to; None for Minari's own.
        options: how to execute the runs. With `resume`, finished datasets are kept and interrupted
            ones continued; with `overwrite`, each is replaced once the new one is complete.
        progress: where to show progress.

    Raises:
        Occupied: a dataset, a card or an interrupted run is in the way.
        InvalidInput, InvalidFile: an existing dataset was made by another run or can't be
            read; or nothing that is asked for is recorded.
        Failed: this machine gets other episodes than recorded. The datasets and the card are
            finished. Or, to verify, a set isn't there or isn't known to be right.
    """
    progress = progress or Progress(options.quiet)
    root = Path(out) if out is not None else minari_root()
    folder = root / "knotgym"
    wanted = _recorded(config) if config.recorded else [*config.sets()]
    if config.verify:
        _require_known([config.dataset_id for config in wanted], root, progress)
        return folder
    for part in wanted:  # before anything is made
        require_collectable(part, root, options)
    _require_own_card(folder, options)
    for number, part in enumerate(wanted, 1):
        size = f"{part.steps:,} steps" if part.steps else f"{part.episodes} episodes"
        progress.say(f"set {number} of {len(wanted)}: {part.dataset_id}, {size}")
        recorded = _recording(part.dataset_id) if config.recorded else None
        collect(part, root, options, progress=progress, recorded=recorded)
    sets = _described(config, root)
    _write_card(sets, config.seed, folder)
    progress.say(f"{folder}: {len(wanted)} sets, README.md, suite.json")
    agreement = {part.dataset_id: sets[part.dataset_id]["recorded"] for part in wanted}
    differing = [f"{name} {how}" for name, how in agreement.items() if how.startswith("differs")]
    if config.recorded and differing:
        raise Failed(
            f"this machine gets other episodes than recorded: {'; '.join(differing)}; the sets are"
            " kept, as a collection on this machine would be, and the card says so"
        )
    return folder


class KnownDigests(dict[str, Any]):
    """The digests that sets are known by: id -> `steps` and `values`."""

    @staticmethod
    def page() -> str:
        """Return a table of all, in Markdown."""
        head = ["| set | steps | digest of values |", "| --- | ---: | --- |"]
        rows = (f"| `{k}` | {v['steps']:,} | `{v['values'][:16]}` |" for k, v in DIGESTS.items())
        return "\n".join([*head, *rows])


DIGESTS = KnownDigests(json.loads(_DIGESTS.read_text("utf-8")))


def _values(dataset: EpisodeDataset) -> str:
    """Hash the values of a set, in whatever files it is."""
    return hashlib.sha256(json.dumps(dataset.digests, sort_keys=True).encode()).hexdigest()


def _require_known(ids: Iterable[str], root: Path, progress: Progress) -> None:
    """Compare finished sets with the digests that are known, and with those in their files.

    Raises:
        Failed: one isn't there, isn't whole, has other values, or none are known of it.
    """
    wrong = 0
    for name in ids:
        said, right = "isn't there", DIGESTS.get(name, {}).get("values")
        if (root / name).exists():
            try:
                dataset = open_episodes(root / name)
                faults = [*dataset.digest_faults(), *MinariMetadata.faults(dataset)]
                values = _values(dataset)
                other = f"has other values than the known {right[:16]}" if right else "isn't known"
                said = one_line(faults[0]) if faults else "" if values == right else other
                progress.say(f"{name}: {values}: {said or 'known'}")
            except KnotgymError as error:
                said = one_line(error)
                progress.say(f"{name}: {said}")
        else:
            progress.say(f"{name} {said}")
        wrong += bool(said)
    if wrong:
        raise Failed(f"{wrong} of these sets aren't known to be right")


def _recording(dataset_id: str) -> Path | None:
    """Return the recording of a set that ships; None if there is none."""
    path = _RECORDINGS / f"{dataset_id.replace('/', '-')}.h5"
    return path if path.is_file() else None


def _recorded(config: SuiteConfig) -> list[CollectConfig]:
    """List the requested sets that are recorded, by the policy that acted, and the random ones of
    the same setups.
    """
    every = replace(config, policies=None).sets()
    setups, wanted = {part.task for part in every if _recording(part.dataset_id)}, []
    for part in config.sets():
        if path := _recording(part.dataset_id):
            policy = common.from_json(PolicyConfig, run_facts(path)["config"]["policy"])
            wanted.append(replace(part, policy=policy))
        elif part.policy.policy == "random" and part.task in setups:
            wanted.append(part)
    if not wanted:
        there = ", ".join(sorted(path.stem for path in _RECORDINGS.iterdir())) or "no recording"
        raise InvalidFile(f"nothing of this is recorded; there is {there}")
    return wanted


def _require_own_card(folder: Path, options: RunOptions) -> None:
    """Raise Occupied if the card replaces other files than a suite's, unless `options`
    overwrite.
    """
    try:
        is_suite = common.read_json(folder / "suite.json")["format"] == _FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        is_suite = False
    if not (is_suite and options.resume):
        for name in _CARD:
            require_output(folder / name, folder=False, overwrite=options.overwrite, reads=[])


def _described(config: SuiteConfig, root: Path) -> dict[str, Any]:
    """Describe every existing dataset of the benchmark, of this run or earlier ones, by id."""
    whole = SuiteConfig(observation=config.observation, seed=config.seed)
    parts = [replace(whole, engine=engine) for engine in ENGINES]
    parts += [replace(whole, states=(BENCH,), size=size) for size in SIZES]
    ids = [config.dataset_id for part in parts for config in part.sets()]
    return {name: _describe_set(root / name) for name in ids if (root / name).exists()}


def _describe_set(made: Path) -> dict[str, Any]:
    """Describe a finished dataset that `collect` or the suite made.

    Args:
        made: folder of the dataset.

    Returns:
        Its settings and size; `sha256`, of its starts and pulls; `recorded`: "no" recording,
        "same", or how it differs: from an episode of the recording, from its own digest, or from
        what `_DRAWN` of its episodes give when they are played again. What else it holds is only
        compared with the digest that stands beside it.

    Raises:
        InvalidInput: it isn't such a dataset.
    """
    try:
        dataset = open_episodes(made)
        config, versions = run_facts(made)["config"], run_facts(made)["versions"]
        policy, seed = config["policy"]["policy"], config["seed"]
    except (KnotgymError, KeyError, TypeError) as error:
        fault = f"{made} is none of the suite's sets"
        raise InvalidInput(f"{fault} ({one_line(error)}); remove it") from error
    task, episodes, rows = dataset.task, dataset.episodes, dataset.episodes.episodes
    digests, agreement = dataset.digests, "no"
    known_values = DIGESTS.get(dataset.name, {}).get("values")
    if path := _recording(dataset.name):
        recording = recording_at(path)
        some = recording.select(np.arange(min(rows.rows, recording.episodes.rows)))
        same = episodes.select(np.arange(some.episodes.rows)).recording().differing(some)
        first = next((row for row, *_ in same), None)
        first = some.episodes.rows if first is None and some.episodes.rows < rows.rows else first
        agreement = "same" if first is None else f"differs from episode {first}"
        # what stepping gave besides, such as rewards: its digest was written with it
        stored = dataset.attributes.get("expansion")
        if first is None and stored not in (None, digests.get("expansion")):
            agreement = "differs from its own digest: knotgym dataset verify says where"
        elif first is None:
            drawn = dataset.drawn(_DRAWN)
            if expanded(drawn, replay).episodes.differences(drawn.episodes):
                agreement = "differs when played again: knotgym dataset verify says where"
    written = [file for file in (made / "data").iterdir() if file.is_file()]
    return {
        **{name: getattr(task, name) for name in ("task", "nx", "split", "endless", "engine")},
        "states": task.states or "readable",
        "policy": policy,
        "seed": seed,
        "episodes": rows.rows,
        "succeeded": int(rows["success"].sum()),
        "steps": int(rows["length"].sum()),
        **episodes.distinct(),
        "bytes": sum(file.stat().st_size for file in written),
        "sha256": digests["digest"],
        "values": (values := _values(dataset)),
        "as known": {None: "not known", values: "yes"}.get(known_values, "no"),
        "versions": versions,
        "recorded": agreement,
    }


def _write_card(sets: Mapping[str, Any], seed: int, folder: Path) -> None:
    made_by = {"knotgym": knotgym.__version__, "seed": seed}
    report = {"format": _FORMAT, "format_version": 1, **made_by, "sets": sets}
    folder.mkdir(parents=True, exist_ok=True)
    references = [
        (measured, setup, f"{scores['random']:.2f}", f"{scores['expert']:.2f}", scores["episodes"])
        for measured, protocol in reference_scores().items()
        for setup, scores in protocol["cells"].items()
    ]
    card = suite_card(report, references)
    texts = json.dumps(report, indent=1, sort_keys=True) + "\n", card
    for name, text in zip(_CARD, texts, strict=True):
        with common.atomic_write(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
