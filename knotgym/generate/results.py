"""Results of an evaluation: one per policy and setup, printed beside reference scores."""

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt, PositiveInt
from rich.console import Console

from knotgym.common import (
    InvalidFile,
    InvalidInput,
    Mark,
    Share,
    configuration,
    from_json,
    read_json,
)
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig, task_sides
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.rope import ENGINES, MUJOCO
from knotgym.runs import cluster_interval, narrow_table
from knotgym.states import SPLITS

Columns = Mapping[str, NDArray[Any]]
_SETUP = ("policy", "task", "split", "nx")  # columns
_WORST = 4  # goals that are listed of a setup
_OUTCOMES = ("start", "goal", "success", "steps")
_REFERENCES = Path(__file__).parent / "data" / "references.json"


@configuration
class Result:
    """Result of one policy in one setup.

    Attributes:
        policy, task, nx, split: the setup.
        action: the view that the policy acted in, see `TaskConfig`.
        episodes, successes: numbers of episodes.
        success_rate, low, high: success rate and the 95 % interval of `cluster_interval`.
        steps: mean over successful episodes; None if there are none.
        mean_return: mean return of an episode.
        planned_actions: pulls simulated for planning, mean per episode.
        simulation_failures: episodes that ended because the simulation diverged.
        start_states, goal_states: source of the states, "own" for the requested state file or
            "shipped" for the included one.
        outcomes: for each episode `start` and `goal` (rows of those state files), `success` (0 or
            1) and `steps`.
    """

    policy: str
    task: str
    nx: int
    split: str
    action: str
    episodes: PositiveInt
    successes: NonNegativeInt
    success_rate: Share
    low: Share
    high: Share
    steps: float | None
    mean_return: float
    planned_actions: float
    simulation_failures: NonNegativeInt
    start_states: str
    goal_states: str
    outcomes: dict[str, tuple[Annotated[int, Field(ge=0, lt=2**31)], ...]]

    def __post_init__(self) -> None:
        lengths = {len(self.outcomes.get(name, ())) for name in _OUTCOMES}
        if lengths != {self.episodes} or max(self.outcomes["success"]) > 1:
            raise InvalidInput("outcomes aren't columns of one whole number an episode")
        totals = _totals(self.outcomes)
        told = np.array([getattr(self, name) for name in totals], np.float64)  # None is nan
        # sums of floats differ by machine
        if not np.allclose(told, np.array([*totals.values()], np.float64), equal_nan=True):
            raise InvalidInput("its success rate, interval or steps aren't those of its outcomes")

    @classmethod
    def of(cls, policy: str, action: str, task: TaskConfig, played: Columns) -> "Result":
        """Return the result of a setup.

        Args:
            policy: name of the policy.
            action: view that it acts in.
            task: the environment.
            played: columns of the episodes.
        """
        named = {"start": "start", "goal": "goal", "success": "success", "steps": "length"}
        listed = {name: (*played[of].astype(np.int64).tolist(),) for name, of in named.items()}

        (starts, goals), *_ = task_sides(task)
        return cls(
            policy=policy,
            task=task.tasks[0],
            nx=task.crossings[0],
            split=task.split,
            action=action,
            episodes=len(played["length"]),
            **_totals(listed),
            mean_return=float(played["return_"].mean()),
            planned_actions=float(played["planner_steps"].mean()),
            simulation_failures=int(played["diverged"].sum()),
            start_states=starts.origin,
            goal_states=goals.origin,
            outcomes=listed,
        )


def _totals(outcomes: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """Return the number of successes, their rate, its interval, and the mean steps to one."""
    success = np.array(outcomes["success"], bool)
    low, high = cluster_interval(outcomes["success"], outcomes["start"], outcomes["goal"])
    steps = float(np.array(outcomes["steps"])[success].mean()) if success.any() else None
    rates = {"success_rate": float(success.mean()), "low": low, "high": high}
    return {"successes": int(success.sum()), **rates, "steps": steps}


def reached(played: Columns) -> dict[str, int]:
    """Count the episodes that reached the goal, of the columns of a call."""
    return {"reached the goal": int(played["episodes/success"].sum())}


class Evaluated(NamedTuple):
    """A file of `knotgym evaluate --out`.

    Attributes:
        config: what was evaluated.
        results: one for each setup.
        states: digests of the sets of states.
        engine: digest of what the engine did; "" if the file doesn't say it.
        beside: digests of what was written with it.
    """

    config: EvaluateConfig
    results: list[Result]
    states: dict[str, str]
    engine: str
    beside: dict[str, str]


def read_evaluation(path: Path) -> Evaluated:
    """Read a file of `knotgym evaluate --out`; raise InvalidFile if it is no such file."""
    raised = ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError
    with InvalidFile.instead(f"{path} isn't a file of `knotgym evaluate --out`", *raised):
        content = read_json(path)
        results = [from_json(Result, result) for result in content["results"]]
        config = from_json(EvaluateConfig, content["config"])
        states = dict((content["source"] or {}).get("states", {}))
        engine, beside = str(content.get("engine", "")), dict(content.get("beside", {}))
        setups = [(p.policy, t.task, t.split, t.nx) for p, t in config.setups()]
        if setups != [(r.policy, r.task, r.split, r.nx) for r in results]:
            raise InvalidInput("its results aren't those of its configuration's setups")
        return Evaluated(config, results, states, engine, beside)


def show(
    results: Sequence[Result],
    console: Console,
    engine: str = MUJOCO,
    protocol: str = "",
    tasks: Sequence[TaskConfig] = (),
) -> None:
    """Print a row per setup, and a matrix if there are several nx, in at most 80 columns.

    Args:
        results: one for each setup.
        console: where to print.
        engine: that the episodes were played with; named if it isn't the reference.
        protocol: of the evaluation.
        tasks: of the results; with them the goals that failed most are listed.
    """
    say = partial(console.print, highlight=False)
    steps = ["steps"] * any(result.steps is not None for result in results)
    table = narrow_table((*_SETUP, "success", "95 % interval", *steps, "return"), left=_SETUP[:3])
    # policies of one name, with other settings, are told apart by numbers
    rows: dict[tuple[str, str, str, int], Result] = {}
    for result in results:
        name, number = _acting(result), 1
        while rows.setdefault((name, result.task, result.split, result.nx), result) is not result:
            number, name = number + 1, f"{_acting(result)} ({number + 1})"
    for (*setup, nx), result in rows.items():
        took = [""] if result.steps is None else [f"{result.steps:.1f}"]
        rates = [f"{100 * rate:.1f}" for rate in (result.success_rate, result.low, result.high)]
        interval = f"{rates[1]} to {rates[2]} %"
        cells = f"{rates[0]} %", interval, *took[: len(steps)], f"{result.mean_return:.2f}"
        table.add_row(*setup, str(nx), *cells)
    console.print(table)
    columns = *_SETUP, "goal", "failed", "of"
    failed = narrow_table(columns, title="goals that failed most", left=(*_SETUP[:3], "goal"))
    for result, asked in zip(results, tasks, strict=False):
        goals = task_sides(asked)[0][1].states.gauss_code[[*result.outcomes["goal"]]]
        for goal, (missed, count) in Episodes.missed(goals, result.outcomes["success"])[:_WORST]:
            who = _acting(result), result.task, result.split, str(result.nx)
            failed.add_row(*who, goal, str(missed), str(count))
    if failed.row_count:
        console.print(failed)
    for result in results:
        if result.planned_actions:
            say(
                f"{result.policy}, {result.task} nx {result.nx}, {result.split}: planned with"
                f" {result.planned_actions:.0f} simulated pulls an episode"
            )
    mixed = [result for result in results if result.start_states != result.goal_states]
    for task, nx in dict.fromkeys((result.task, result.nx) for result in mixed):
        say(f"{task} nx {nx}: the state file has no plain loops; the included ones are used.")
    if protocol:
        say(f"protocol {protocol}")
    if not ENGINES[engine].is_reference:
        say(f"engine {engine}, not the reference engine {MUJOCO}")
    numbers = list(dict.fromkeys(result.nx for result in results))
    if len(numbers) > 1:
        heads = *_SETUP[:3], *(f"nx {nx}" for nx in numbers)
        matrix = narrow_table(heads, title="success, %", left=_SETUP[:3])
        for acting, task, split in dict.fromkeys(key[:3] for key in rows):
            success = [rows[acting, task, split, nx].success_rate for nx in numbers]
            matrix.add_row(acting, task, split, *(f"{100 * rate:.1f}" for rate in success))
        console.print(matrix)


def _acting(result: Result) -> str:
    """Name the policy, and the view that it acted in unless that is "pull"."""
    return result.policy + f" ({result.action})" * (result.action != TaskConfig.action)


def references_of(task: TaskConfig) -> dict[str, Any]:
    """Return the reference scores of a task as Minari names them, each None if there are none."""
    # the scores are of the usual rules and rope, on states that were split by state
    plain = TaskConfig(**Mark.values(task, "named"))
    rules = [Mark.values(config, "rules", "physics") for config in (task, plain)]
    is_usual = rules[0] == rules[1] and not SPLITS[task.split].by_code
    protocol = reference_scores().get(f"{task.states or 'readable'}-{task.engine}", {})
    scores = protocol.get("cells", {}).get(task.name, {}) if is_usual else {}
    return {
        "ref_min_score": scores.get("random"),
        "ref_max_score": scores.get("expert"),
        "num_episodes_average_score": scores.get("episodes"),
    }


def reference_scores() -> dict[str, Any]:
    """Return what was measured, by states and engine, for example "bench-chain".

    Each has the `command` that measured it, and `cells`: by set-up, for example "tie-nx3", the mean
    returns of `random` and `expert`, and the number of `episodes`.
    """
    return dict(json.loads(_REFERENCES.read_text(encoding="utf-8")))
