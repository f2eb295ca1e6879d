"""Entries: scores that anyone can replay, because they are the pulls of every episode.

`knotgym evaluate --record FILE` writes one, `knotgym dataset verify FILE` replays it. An entry is a
file of episodes: a recording of all setups, one after the other (`setup`), with two attributes.
No word of the file is taken for a start or an outcome: each start is drawn from the seed, each pull
is made again, and successes, steps and interval are recounted. What no replay can prove, such as
that a policy and not a search chose the pulls, is shown as claimed.

    protocol    `config` of the evaluation, with its seed; `states`, digests of the sets that starts
                and goals are from
    claims      for each setup what its policy acted in and observed, whether it plans, and pulls
                that it simulated for each one made; its training (learner, data with digests,
                parameters, updates, seconds, seed, command) and files; versions and commit
"""

import json
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knotgym import common
from knotgym.common import Counts, InvalidFile, KnotgymError, Stream
from knotgym.control import PolicyConfig, make_policy, replay, rollouts
from knotgym.datasets import EpisodeDataset, Episodes, open_episodes, write_episodes
from knotgym.envs import TaskConfig
from knotgym.generate.collection import blocks
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.generate.old_formats import OLD_ENTRY, old_entry
from knotgym.generate.results import Result, show
from knotgym.rope import ENGINES
from knotgym.runs import Progress, executor, identity
from knotgym.runs import Result as Kept
from knotgym.states import is_bundled, resolve_states

_DRAWN = 4  # episodes of a setup that a policy that plans plays again; others play all
_RAISED = KnotgymError, LookupError, TypeError, ValueError  # by attributes of a stranger's


class Entry(NamedTuple):
    """An entry that was read.

    Attributes:
        config: of the evaluation.
        setups: the episodes of each setup, a recording.
        claimed: what replay doesn't prove, a dictionary for each setup.
    """

    config: EvaluateConfig
    setups: list[Episodes]
    claimed: list[dict[str, Any]]

    def __str__(self) -> str:
        rows, pulls = (sum(episodes[k].rows for episodes in self.setups) for k in range(2))
        return f"{rows} episodes of {pulls - rows} pulls, all replayed"

    def faults(self, progress: Progress) -> Iterator[str]:
        """Replay all episodes, show what they score beside what is claimed, and yield faults."""
        results = list[Result]()
        for result, faults in self.recounted():
            results.append(result)
            yield from faults
        if not progress.quiet:
            config, tasks = self.config, [task for _, task in self.config.setups()]
            show(results, progress.console, config.task.engine, config.protocol, tasks)
        for number, claimed in enumerate(self.claimed, 1):
            progress.say(common.one_line(f"setup {number}, claimed: {json.dumps(claimed)}"))

    def recounted(self) -> Iterator[tuple[Result, list[str]]]:
        """Replay: yield the result of each setup, and its faults."""
        config, seed_of = self.config, Stream.EVALUATION_EPISODE.derived_seed
        with executor(ENGINES[config.task.engine].workers) as pool:
            total = config.episodes * len(self.setups)
            for number, (policy, task) in enumerate(config.setups()):
                first = number * config.episodes
                Counts.tell("episodes replayed", Counts.from_now(first, pool), total)
                few, stored = blocks(config.episodes, task, policy.plans), self.setups[number]
                parts = [stored.select(np.arange(block.start, block.stop)) for block in few]
                seeds = [[seed_of(config.seed, k) for k in block] for block in few]
                made = [*map(dict[str, Any], pool.map(_replayed, [task] * len(few), seeds, parts))]
                wrong = np.concatenate([part.pop("wrong") for part in made])
                faults = [
                    f"setup {number + 1}, episode {first + k}: replayed, it ends otherwise or comes"
                    " through other states"
                    for k in np.flatnonzero(wrong).tolist()
                ]
                claimed = self.claimed[number]
                if not faults and repeats(policy, claimed.get("versions")):
                    some = [*chain(*seeds)][: _DRAWN if policy.plans else None]
                    drawn = stored.select(np.arange(len(some)))
                    Counts.tell("episodes played again", Counts.from_now(), len(some))
                    if (row := acted_otherwise(policy, task, drawn, some)) is not None:
                        fault = f"{policy.policy}, played again, pulls otherwise"
                        faults.append(f"setup {number + 1}, episode {first + row}: {fault}")
                action = str(claimed.get("action", ""))
                played = Episodes.merged([Episodes.of(part) for part in made]).episodes
                yield Result.of(policy.policy, action, task, played), faults


def write_entry(
    path: Path, config: EvaluateConfig, played: Sequence[Episodes], claimed: list[dict[str, Any]]
) -> None:
    """Write the episodes of all setups, played with all columns of steps, to a file."""
    tasks = [task for _, task in config.setups()]
    protocol = {"config": common.as_json(config), "states": states_digests(config)}
    parts = [episodes.recording().of_setup(number) for number, episodes in enumerate(played)]
    write_episodes(path, parts, tasks, {"protocol": protocol, "claims": claimed})


def read_entry(path: Path) -> Entry | None:
    """Read an entry; None if it isn't a file that says that it is one.

    Raises:
        InvalidFile: it is damaged, changed, incomplete, or made with other states or another rope.
    """
    format = common.format_of(path) if path.is_file() else None
    if format == OLD_ENTRY:
        episodes, said = old_entry(path)
    elif format == EpisodeDataset.FORMAT:
        dataset = open_episodes(path)
        episodes, protocol = dataset.episodes, dataset.attributes.get("protocol")
        if protocol is None:
            return None
        for fault in dataset.digest_faults():
            raise InvalidFile(fault)
        said = {**dataset.attributes, **(protocol if isinstance(protocol, dict) else {})}
    else:
        return None
    with InvalidFile.instead(f"{path} has no valid configuration", *_RAISED):
        config = common.from_json(EvaluateConfig, said["config"])
        tasks = [common.as_json(task) for _, task in config.setups()]
        states, claimed = states_digests(config), [dict(claim) for claim in said["claims"]]
    if said.get("states") != states:
        raise InvalidFile(f"{path} was played from other states than {', '.join(states)} here")
    unlike = config.task.rope_config.unlike(said.get("rope"))
    if unlike := unlike or ENGINES[config.task.engine].unlike(said.get("engine")):
        raise InvalidFile(f"{path} was played with {unlike}")
    rows, steps = episodes
    if rows.rows != len(tasks) * config.episodes:  # before there is an array of so many
        raise InvalidFile(f"{path} has {rows.rows} episodes, other than its configuration asks for")
    of_setup = np.repeat(np.arange(len(tasks)), config.episodes)
    fits = len(claimed) == len(tasks) and said.get("tasks") == tasks
    if not (fits and np.array_equal(rows.get("setup", ()), of_setup)):
        raise InvalidFile(f"{path} doesn't hold the episodes that its configuration asks for")
    wrong = (steps["bead"] >= config.task.beads) | ~(np.abs(steps["force"]) <= 1).all(axis=1)
    for row in episodes.episode_of()[wrong][:1].tolist():
        raise InvalidFile(
            f"{path}, episode {row}: a pull is of a bead or with a force that doesn't exist"
        )
    setups = [episodes.select(of_setup == number) for number in range(len(tasks))]
    return Entry(config, setups, claimed)


def _replayed(task: TaskConfig, seeds: list[int], part: Episodes) -> Kept:
    """Play episodes again; return their columns, and which aren't as recorded, bool (n,)."""
    made = replay(part, task, seeds)
    plans = np.zeros_like(made.episodes["length"])  # a replay plans nothing
    made = made._replace(episodes=made.episodes.replaced(planner_steps=plans))
    wrong = np.zeros(part.episodes.rows, dtype=bool)
    wrong[[row for row, *_ in made.recording().differing(part)]] = True
    return {**made._replace(steps=made.steps.only("bead")).columns(), "wrong": wrong}


def repeats(policy: PolicyConfig, versions: Any) -> bool:
    """Whether a policy of the package, with the seed, decides all pulls of a run, here as there."""
    plain = PolicyConfig()  # searches that a stranger made longer could take hours
    if not policy.is_own or (policy.expert, policy.planner) != (plain.expert, plain.planner):
        return False
    code = versions.get("code") if isinstance(versions, dict) else None
    # other code may plan otherwise
    return not policy.plans or code == identity(policy)["versions"]["code"]


def acted_otherwise(
    policy: PolicyConfig, task: TaskConfig, episodes: Episodes, seeds: list[int]
) -> int | None:
    """Play a policy again; return the first episode that isn't its own, None if all are."""
    made = rollouts(make_policy(policy), task, seeds)
    differing = made.recording().differing(episodes.recording())
    # rows of earlier entries name nobody
    nobody = [(row, "policy") for row in np.flatnonzero(episodes.episodes["policy"] == "recorded")]
    passed = {"planner_steps", *nobody}
    return next((row for row, _, name in differing if not {name, (row, name)} & passed), None)


def states_digests(config: EvaluateConfig) -> dict[str, str]:
    """The digests of the sets of states, by their names; own files have one name."""
    return {
        str(name) if is_bundled(name) else "own": common.sha256(resolve_states(name))
        for _, _, name in common.Mark.fields(EvaluateConfig, config, "states")
    }
