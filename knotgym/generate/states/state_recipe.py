"""The recipe of `knotgym generate`: states from their sources, then their demonstrations.

rows of the sources, see `states.sources`  (they pass the filter and are new)
  -> splits -> states.h5 -> the expert's episodes to their codes -> gallery, card, manifest
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Table, as_json
from knotgym.control import compile_planning
from knotgym.datasets import finish_states
from knotgym.generate.states.demonstrations import demonstrate
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.state_rows import ROWS, joined, states_of
from knotgym.runs import Progress, Recipe, RunOptions, compile_first, identity, run
from knotgym.states import SOURCES, States, write_states
from knotgym.topology import type_of

# Settings that only say when a run gives up. A run may be resumed with others.
_PATIENCE = ("attempts", "demonstration_attempts")


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
    return run(
        lambda place: _state_recipe(config, place, made_by),
        Path(out),
        made_by,
        options,
        progress,
        prepare=partial(compile_first, engine=config.engine_used, draws=True, plan=plan),
    )


def _state_recipe(config: GenerateConfig, place: Path, made_by: Mapping[str, Any]) -> Recipe[str]:
    """Make the folder `place`; return a summary.

    Args:
        config: which states to make.
        place: a new folder, beside which files for the workers may be written.
        made_by: identity of the run, for the manifest.
    """
    report: dict[str, Any] = {
        "version": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "source": " and ".join(one.source for one in config.parts),
        "knot": type_of(config.knot),
    }
    rows, split = yield from _rows(config, report)
    states = states_of(rows, split, config.engine_used, made_by["config"])
    place.mkdir(parents=True)
    if config.demonstrations:
        states = yield from demonstrate(config, states, place, report)
    write_states(place / "states.h5", states)
    finish_states(place, states, report, made_by)
    return _summary(states, report)


def _rows(config: GenerateConfig, report: dict[str, Any]) -> Recipe[tuple[Table, NDArray[np.str_]]]:
    """Take states from their sources, with their splits; no two are near duplicates."""
    parts, splits = list[Table](), list[NDArray[np.str_]]()
    for one in config.parts:
        found: dict[str, Any] = {}
        source = SOURCES[one.source]
        apart_from = [part["points"] for part in parts]
        rows = yield from source.function("rows")(one, found, apart_from)
        splits.append(source.function("splits")(one, rows))
        parts.append(rows)
        report["attempts"] = report.get("attempts", 0) + found.pop("attempts")
        report.update({name: {**report.get(name, {}), **each} for name, each in found.items()})
    schema = ROWS.only(*{name for part in parts for name in part})
    rows = joined(part.filled(schema) for part in parts)
    order = np.argsort([config.nx.index(nx) for nx in rows["nx"].tolist()], kind="stable")
    return rows.take(order), np.concatenate(splits)[order]


def _summary(states: States, report: Mapping[str, Any]) -> str:
    codes = len(set(states.gauss_code.tolist()))
    shown = f", {report['demonstrations']} demonstrations" if "demonstrations" in report else ""
    return f"{len(states)} states of {codes} codes{shown}"
