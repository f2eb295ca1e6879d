"""The card of the fixed benchmark: tasks, protocol, datasets, reference scores and results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from knotgym.datasets.cards.citation import TO_CITE, code_span, plain
from knotgym.datasets.cards.state_card import table
from knotgym.generate.episodes.suite_scores import score_tables

_TASKS = (
    ("unknot", "nx crossings", "a plain loop"),
    ("tie", "a plain loop", "nx crossings"),
    ("convert", "nx - 1 crossings", "nx crossings"),
)
_PROTOCOL = """\
A learner is trained on the sets below alone, all of the train split, and measured on the test
split: N = 256 episodes a set-up, seed 0, horizon 50, success when the rope's Gauss code (without
chirality) is the goal's:

    knotgym evaluate --policy LEARNER --task unknot,tie,convert --nx 2-4 --out FILE.json

once as it is, and once with `--states random-walk`. Episodes of an evaluation are never those of
the sets, whatever the seed. Success rates have 95 % intervals from a bootstrap over start and goal
states (`knotgym.runs.intervals.cluster_interval`). Files in the folder `evaluations` beside this
card show in its table of results when `knotgym suite --resume` is run again. Rows that used more
than these sets (more episodes, or the simulator) say so."""


def suite_card(report: Mapping[str, Any], references: Mapping[str, Any]) -> str:
    """Return the card as Markdown.

    Args:
        report: content of suite.json.
        references: mean returns of a random and an expert policy by setup, see
            `collect.reference_scores`.
    """
    sets = report["sets"]
    return "\n".join(
        [
            "---",
            "license: cc-by-4.0",
            "tags: [knot-theory, gauss-code, mujoco, offline-reinforcement-learning]",
            "---",
            "",
            "# The benchmark of knotgym",
            "",
            f"{len(sets)} sets, {sum(one['episodes'] for one in sets.values())} episodes,"
            f" {sum(one['steps'] for one in sets.values())} steps, made by `knotgym suite`"
            f" {report['knotgym']} with seed {report['seed']}. `suite.json` holds the same in"
            " numbers, with the SHA-256 of every file. The same command makes the same bytes.",
            "",
            "## Tasks",
            "",
            *table(("task", "the rope begins as", "the goal shows"), _TASKS),
            "",
            "nx is 2, 3 or 4. Actions, observations and rewards are those of the environments"
            " `knotgym/Unknot-v0`, `knotgym/Tie-v0` and `knotgym/Convert-v0`.",
            "",
            "## Protocol",
            "",
            _PROTOCOL,
            "",
            "## Sets",
            "",
            *table(
                (
                    *("id", "states", "engine", "policy", "seed", "episodes", "steps"),
                    *("reached the goal", "MB", "SHA-256 of main_data.hdf5"),
                ),
                _rows(sets),
            ),
            "",
            "## Reference scores",
            "",
            "Mean returns on readable states, that Minari's normalized scores are taken between.",
            "",
            *table(
                ("set-up", "random", "expert", "episodes"),
                [
                    (setup, f"{one['random']:.2f}", f"{one['expert']:.2f}", one["episodes"])
                    for setup, one in references.items()
                ],
            ),
            "",
            "## Results",
            *(
                score_tables(report["results"], "###")
                or ["", "None yet: no evaluation file lies in `evaluations`."]
            ),
            "",
            *TO_CITE,
        ]
    )


def _rows(sets: Mapping[str, Any]) -> Iterator[tuple[object, ...]]:
    for name, one in sorted(sets.items()):
        yield (
            code_span(name),
            plain(one["states"]),
            plain(one["engine"]),
            plain(one["policy"]),
            one["seed"],
            one["episodes"],
            one["steps"],
            f"{100 * one['succeeded'] / max(one['episodes'], 1):.1f} %",
            f"{one['bytes'] / 1e6:.1f}",
            f"`{one['sha256']['main_data.hdf5'][:16]}...`",
        )
