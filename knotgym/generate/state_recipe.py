"""The recipe of `knotgym generate`: states from their sources, then their demonstrations.

rows of the sources, see `states.sources`  (they pass the filter and are new)
  -> splits -> states.h5 -> the expert's episodes to their codes -> gallery, card, manifest

A demonstration starts at the simplest diagram of the knot, the plain loop for the unknot; loops are
demonstrated from states with one crossing. If the rollout doesn't reach the code, others are made
from other starts: by the expert, first in haste, and then by the planner.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Stream, Table, as_json
from knotgym.control import PassPlannerConfig, PolicyConfig, compile_planning, make_policy, rollouts
from knotgym.datasets import Episodes, MinariMetadata, finish, publish
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.generate.drawing_source import CALLS, drawn_rows, splits_of
from knotgym.generate.generate_config import GenerateConfig
from knotgym.generate.state_rows import ROWS, joined, states_of
from knotgym.rope import ENGINES
from knotgym.runs import Call, Progress, Recipe, Result, RunOptions, identity, run
from knotgym.states import SOURCES, SPLITS, STATE_SPLITS, States, write_states
from knotgym.topology import UNKNOT, Knot

# Settings that only say when a run gives up. A run may be resumed with others.
_PATIENCE = ("attempts", "demonstration_attempts")
HORIZON = 200  # actions, more than any demonstration needs
# drawn states that episodes start from, in both splits together
_STARTS: dict[str, Any] = {
    **{"source": "drawing", "count": 8, "every_code": 0, "codes": (), "train_share": 0.5},
    "demonstrations": False,
}
# Rollouts of the expert before the planner's turn: the first are short, and most of them have a few
# of its 60,000 pulls for a last resort, because another start takes less time. Of the eleven nx 4
# goals that the first two left, the third reached eight, after at most 18,129 pulls; the fourth two
# more, after 24,549 and 46,789. Most episodes have 15 to 45 actions.
_HASTY, _SHORT = 2, 60
_LAST_RESORT = (5000, 5000, 20000, 60000)


def make_states(
    config: GenerateConfig, out: Path, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make states and their demonstrations in the new folder `out`, and return it.

    A shard makes its journal instead, and returns that.

    Args:
        config: which states.
        out: the folder.
        options: how the run is executed.
        progress: shows what is done.

    Raises:
        Occupied, InvalidInput, InvalidFile: as `runs.runner.run` raises.
        Failed: states are missing, although `config.attempts` are used up.
    """
    asked = {name: value for name, value in as_json(config).items() if name not in _PATIENCE}
    made_by = identity(config, fields=asked)
    plan = compile_planning if config.demonstrations else None
    compiles = {"engine": config.engine_used, "draws": True, "plan": plan}
    recipe = partial(_state_recipe, config, made_by)
    return run(recipe, Path(out), made_by, options, progress, compiles=compiles)


def _state_recipe(config: GenerateConfig, made_by: Mapping[str, Any], place: Path) -> Recipe[str]:
    """Make the folder `place`; return a summary.

    Args:
        config: which states to make.
        made_by: identity of the run, for the manifest.
        place: a new folder, beside which files for the workers may be written.
    """
    report: dict[str, Any] = {
        "version": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "source": " and ".join(part.source for part in config.parts),
        "knot": Knot(config.knot).type,
    }
    rows, split = yield from _rows(config, report)
    states = states_of(rows, split, config.engine_used, made_by["config"])
    place.mkdir(parents=True)
    if config.demonstrations:
        states = yield from _demonstrate_all(config, states, place, report)
    write_states(place / "states.h5", states)
    finish(place, report, made_by, states)
    codes = len(set(states.gauss_code.tolist()))
    shown = f", {report['demonstrations']} demonstrations" if config.demonstrations else ""
    return f"{len(states)} states of {codes} codes{shown}"


def _rows(config: GenerateConfig, report: dict[str, Any]) -> Recipe[tuple[Table, NDArray[np.str_]]]:
    """Take states from their sources, with their splits; no two are near duplicates."""
    parts, splits = list[Table](), list[NDArray[np.str_]]()
    for part in config.parts:
        counts: dict[str, Any] = {}
        source = SOURCES[part.source]
        apart_from = [part["points"] for part in parts]
        rows = yield from source.function("rows")(part, counts, apart_from)
        splits.append(source.function("splits")(part, rows))
        parts.append(rows)
        report["attempts"] = report.get("attempts", 0) + counts.pop("attempts")
        report.update({name: {**report.get(name, {}), **each} for name, each in counts.items()})
    schema = ROWS.only(*{name for part in parts for name in part})
    rows = joined(part.filled(schema) for part in parts)
    order = np.argsort([config.nx.index(nx) for nx in rows["nx"].tolist()], kind="stable")
    return rows.take(order), np.concatenate(splits)[order]


def _demonstrate_all(
    config: GenerateConfig, states: States, place: Path, report: dict[str, Any]
) -> Recipe[States]:
    """Demonstrate the codes of a set of states, in Minari datasets below the folder `place`.

    Args:
        config: of the run.
        states: the set.
        place: a folder, beside which a file for the workers is written.
        report: gets the number of demonstrations, and the codes that have none.

    Returns:
        The states, with where their demonstrations are.
    """
    starts, sides = yield from _start_rows(config, states)
    playing, path = states, place.parent / "with-starts.h5"
    if starts.rows:
        further = states_of(starts, sides, states.engine, states.attributes["config"])
        playing = States(Table.joined([states.table, further.table]), states.attributes)
    write_states(path, playing)
    made = yield from _demonstrated(config, playing, len(states), path)
    states = _published(made, config, states, place / "minari", path)
    shown = states.source["dataset"] != ""
    report["demonstrations"] = int(shown.sum())
    lacking = ~shown & np.isin(states.nx, _demonstrated_nx(config))
    report["undemonstrated"] = np.unique(states.gauss_code[lacking]).tolist()
    return states


def _start_rows(config: GenerateConfig, states: States) -> Recipe[tuple[Table, NDArray[np.str_]]]:
    """Draw the states that demonstrations start from, where the set itself has none.

    The set that ships has plain loops, so ties of the unknot need none.

    Args:
        config: of the run.
        states: the set.

    Returns:
        The rows to start from, none near a state of the set, and their splits.
    """
    least, parts, splits = Knot(config.knot).diagram.nx, list[Table](), [states.split[:0]]
    needed = {least} if max(config.nx) > least else set()
    if 0 in config.nx:
        needed.add(1)
    for crossings in sorted(needed):
        there = set(states.split[states.nx == crossings].tolist())
        if there == set(STATE_SPLITS) or (not crossings and not there):
            continue
        settings: dict[str, Any] = {"nx": (crossings,), "engine": config.engine_used}
        starts = replace(config, **_STARTS, **settings)
        others = [states.points, *(part["points"] for part in parts)]
        rows = yield from drawn_rows(starts, {}, others, f"drawing starts, {crossings}")
        parts.append(rows)
        splits.append(splits_of(starts, rows))
    return joined(parts), np.concatenate(splits)


def _demonstrated_nx(config: GenerateConfig) -> list[int]:
    """Return the numbers of crossings whose states are demonstrated.

    The simplest diagrams of a knot are none; they are the starts. Loops are led to from curls.
    """
    least = Knot(config.knot).diagram.nx
    return [nx for nx in config.nx if nx > least or not nx]


def _demonstrated(
    config: GenerateConfig, states: States, count: int, path: Path
) -> Recipe[dict[int, Episodes]]:
    """Demonstrate the codes of the first `count` states; return the episode of each, by its row.

    Args:
        config: of the run.
        states: those to demonstrate, then further ones to start from.
        path: a file with these states, which workers can read.
    """
    made: dict[int, Episodes] = {}
    kinds = [(nx, split) for nx in _demonstrated_nx(config) for split in STATE_SPLITS]
    tasks = {kind: replace(_task_of(config, *kind), states=str(path)) for kind in kinds}
    goals = {kind: [k for k in states.rows(*kind).tolist() if k < count] for kind in kinds}
    attempt = 0
    while (left := sum(map(len, goals.values()))) and attempt < config.demonstration_attempts:
        size = min(ENGINES[config.engine_used].together, -(-left // CALLS))
        # Patient attempts take long, so the last goals get several at once; the first that reaches
        # a goal counts, as if the others had not been made.
        after = attempt + (max(1, CALLS // left) if attempt >= _HASTY else 1)
        calls = list[Call]()
        for number in range(attempt, min(after, config.demonstration_attempts)):
            for (nx, split), rows in goals.items():
                for part in np.array_split(rows, -(-len(rows) // size)) if rows else ():
                    name = f"demonstrations, attempt {number}: {nx} {split} {part[0]}"
                    arguments = tasks[nx, split], config.seed, part.tolist(), number
                    calls.append(Call(name, _demonstrate, arguments, len(part)))
        for result in (yield calls):
            episodes = Episodes.of(result)
            for k, goal in enumerate(episodes.episodes["goal"].tolist()):
                made.setdefault(goal, episodes.select([k]))
        goals = {kind: [k for k in rows if k not in made] for kind, rows in goals.items()}
        attempt = after
    return made


def _demonstrate(task: TaskConfig, seed: int, goals: Sequence[int], attempt: int) -> Result:
    """Roll out a policy towards some goals; return the successful episodes as flat columns.

    Args:
        task: the task, whose states are a file.
        seed: of the run.
        goals: rows of that file.
        attempt: number of the rollout; another start for each.
    """
    config = PolicyConfig(policy="planner")
    if attempt < len(_LAST_RESORT):
        expert = PassPlannerConfig(last_resort=_LAST_RESORT[attempt])
        config = PolicyConfig(policy="expert", expert=expert)
    if attempt < _HASTY:
        task = replace(task, horizon=min(task.horizon, _SHORT))
    batch, ids = EpisodeBatch(task, len(goals)), np.arange(len(goals))
    for index, goal in enumerate(goals):
        start_seed = Stream.DEMONSTRATED.derived_seed(seed, goal, attempt)
        batch.begin(ids[index : index + 1], [start_seed], {"goal": goal})
    rows = {"start": batch.start_row, "goal": batch.goal_row}
    starts = Episodes.to_begin(batch.start_qpos, batch.seed, **rows)
    played = rollouts(make_policy(config), task, starts, attempt=attempt)
    return played.select(played.episodes["success"]).columns()


def _task_of(config: GenerateConfig, nx: int, split: str) -> TaskConfig:
    """Return the task of the demonstrations of states with nx crossings in a split."""
    task, engine = "tie" if nx else "unknot", config.engine_used
    setup = TaskConfig(task=task, nx=max(1, nx), split=split, engine=engine)
    return replace(setup, observation="both", horizon=HORIZON)


def _dataset_id(nx: int, split: str, knot: str) -> str:
    """Return the id of the Minari dataset that demonstrates the states of an nx, split and knot.

    Demonstrations of loops (nx 0) are episodes of an unknot task, because nothing is tied.

    >>> _dataset_id(3, "train", "0_1")
    'knotgym/tie-nx3/demonstrations-v0'
    >>> _dataset_id(0, "test", "0_1")
    'knotgym/unknot-nx0/demonstrations-test-v0'
    >>> _dataset_id(3, "train", "3_1")
    'knotgym/tie-nx3-3_1/demonstrations-v0'
    """
    name = "demonstrations" if SPLITS[split].trains else f"demonstrations-{split}"
    knotted = "" if knot == UNKNOT else f"-{knot}"
    return f"knotgym/{'tie' if nx else 'unknot'}-nx{nx}{knotted}/{name}-v0"


def _published(
    made: Mapping[int, Episodes], config: GenerateConfig, states: States, root: Path, path: Path
) -> States:
    """Publish the episodes with goals of one nx and split as a Minari dataset, in the order of the
    states; return the states with where they are demonstrated.

    Args:
        made: the episode of each demonstrated state.
        config: of the run.
        states: the set.
        root: Minari root to write below.
        path: file of the states that they were reset from.
    """
    knot, dataset = Knot(config.knot).type, [""] * len(states)
    trajectory, step = (states.source[name].copy() for name in ("trajectory", "step"))
    for nx, split in product(config.nx, STATE_SPLITS):
        parts = [made[row] for row in states.rows(nx, split).tolist() if row in made]
        if not parts:
            continue
        episodes = Episodes.merged(parts)
        rows, name = episodes.episodes, _dataset_id(nx, split, knot)
        metadata = MinariMetadata(
            dataset_id=name,
            algorithm_name="expert",
            description=(
                f"Episodes of the expert that end in the Gauss codes of {rows.rows}"
                f" rope states with {nx} crossings, those of the {split} split. An episode ends"
                " where the rope first shows the code of its goal; the goal itself, another"
                " configuration of that code, is in general not reached."
            ),
        )
        publish([episodes], _task_of(config, nx, split), metadata, root, states=path)
        for number, goal in enumerate(rows["goal"].tolist()):
            dataset[goal], trajectory[goal], step[goal] = name, number, rows["length"][number]
    columns = {"dataset": np.array(dataset), "trajectory": trajectory, "step": step}
    return states.replaced({f"source/{name}": values for name, values in columns.items()})
