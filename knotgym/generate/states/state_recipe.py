"""The recipe of `knotgym generate`: states from their sources, then their demonstrations.

rows = drawing and play | random-walk      (rows that pass the filter and are new)
  -> splits -> states.h5 -> the expert's episodes to their codes -> gallery, card, manifest
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Stream, as_json, generator
from knotgym.control import compile_planning
from knotgym.datasets import finish_states
from knotgym.generate.states.demonstrations import (
    demonstrated,
    demonstrated_nx,
    publish_demonstrations,
    start_rows,
    where_demonstrated,
)
from knotgym.generate.states.drawing_source import drawn_rows
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.state_rows import Rows, joined, states_of, taken
from knotgym.runs import Progress, Recipe, RunOptions, compile_first, identity, run
from knotgym.states import DRAWING, STATE_SPLITS, States, kept_together, split, write_states
from knotgym.topology import GaussCode, type_of

# Settings that only say when a run gives up. A run may be resumed with others.
_PATIENCE = ("attempts", "demonstration_attempts")


def make_states(
    config: GenerateConfig, out: Path, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make states and their demonstrations in the new folder `out`, and return it.

    A shard makes its journal instead, and returns that.

    Raises:
        Occupied, InvalidInput, InvalidFile: as `runs.runner.run` raises.
        Failed: states are missing, although `config.attempts` are used up.
    """
    asked = {name: value for name, value in as_json(config).items() if name not in _PATIENCE}
    made_by = identity(config, fields=asked)

    return run(
        lambda place: _state_recipe(config, place, made_by),
        Path(out),
        made_by,
        options,
        progress,
        prepare=lambda shown, pool: compile_first(
            shown,
            config.engine_used,
            pool=pool,
            draws=True,
            plan=compile_planning if config.demonstrations else None,
        ),
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
    engine, facts = config.engine_used, made_by["config"]
    place.mkdir(parents=True)
    located: dict[str, NDArray[Any]] = {}
    if config.demonstrations:
        # the set and what its demonstrations start from, in a file for the workers
        playing = states_of(*(yield from start_rows(config, rows, split)), engine, facts)
        path = place.parent / "with-starts.h5"
        write_states(path, playing)
        sets = yield from demonstrated(config, playing, len(split), path)
        publish_demonstrations(sets, config, place / "minari", path)
        located = where_demonstrated(config, rows, sets)
        shown = located["dataset"] != ""
        report["demonstrations"] = int(shown.sum())
        lacking = ~shown & np.isin(rows["nx"], demonstrated_nx(config))
        report["undemonstrated"] = np.unique(rows["gauss_code"][lacking]).tolist()
    states = states_of(rows, split, engine, facts, **located)
    write_states(place / "states.h5", states)
    finish_states(place, states, report, made_by)
    return _summary(states, report)


def _rows(config: GenerateConfig, report: dict[str, Any]) -> Recipe[tuple[Rows, NDArray[np.str_]]]:
    """Take states from their sources, with their splits; no two are near duplicates."""
    parts, splits = list[Rows](), list[NDArray[np.str_]]()
    for one in config.parts:
        found: dict[str, Any] = {}
        if one.source == DRAWING:
            rows = yield from drawn_rows(one, found, apart_from=parts)
            splits.append(_splits(one, rows))
        else:
            from knotgym.generate.states.play_source import ropes_of, rows_of_ropes, split_of

            rows = dict((yield from rows_of_ropes(one, found)))
            if len(config.parts) > 1:  # a column that drawings have
                rows["source/drawing"] = np.full(len(rows["nx"]), "")
            splits.append(np.array([split_of(one, rope) for rope in ropes_of(rows)]))
        parts.append(rows)
        report["attempts"] = report.get("attempts", 0) + found.pop("attempts")
        report.update({name: {**report.get(name, {}), **each} for name, each in found.items()})
    rows = joined(parts)
    order = np.argsort([config.nx.index(nx) for nx in rows["nx"].tolist()], kind="stable")
    return taken(rows, order), np.concatenate(splits)[order]


def _splits(config: GenerateConfig, rows: Rows) -> NDArray[np.str_]:
    """Assign drawn rows to train and test; near duplicates stay together."""
    codes = [GaussCode.parse(text) for text in rows["gauss_code_chiral"].tolist()]
    assigned = np.full(len(codes), STATE_SPLITS[0], dtype="<U5")
    for nx in config.nx:
        own = np.flatnonzero(rows["nx"] == nx)
        rng = generator(Stream.SPLIT, config.seed, nx)
        shown = [codes[row] for row in own]
        assigned[own] = split(shown, config.train_share, rng)
    return kept_together(assigned, rows["points"], codes)


def _summary(states: States, report: Mapping[str, Any]) -> str:
    codes = len(set(states.gauss_code.tolist()))
    shown = f", {report['demonstrations']} demonstrations" if "demonstrations" in report else ""
    return f"{len(states)} states of {codes} codes{shown}"
