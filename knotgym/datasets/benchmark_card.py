"""The card of the benchmark."""

from collections.abc import Mapping, Sequence
from typing import Any

from knotgym.datasets.card_texts import code_span, filled_template, plain, table


def suite_card(report: Mapping[str, Any], references: Sequence[Sequence[object]]) -> str:
    """Return the card of the benchmark as Markdown.

    Args:
        report: the content of suite.json.
        references: states and engine, set-up, random, expert and episodes of each score.
    """
    sets = report["sets"]
    columns = "id states split engine policy seed episodes steps starts goals pairs".split()
    head = (*columns, "reached, %", "MB", "as recorded", "digest of values", "as known")
    rows = []
    for name, facts in sorted(sets.items()):
        size, digest = f"{facts['bytes'] / 1e6:.1f}", f"`{facts['values'][:16]}`"
        cells = (plain(facts[key]) for key in columns[1:])
        share = f"{100 * facts['succeeded'] / max(facts['episodes'], 1):.1f}"
        reached = "" if facts["endless"] else share
        made = plain(facts["recorded"]), digest, facts["as known"]
        rows.append((code_span(name), *cells, reached, size, *made))
    return filled_template(
        "suite_card.md",
        count=len(sets),
        episodes=sum(facts["episodes"] for facts in sets.values()),
        steps=sum(facts["steps"] for facts in sets.values()),
        version=report["knotgym"],
        seed=report["seed"],
        sets=table(head, rows),
        references=table(
            ("states and engine", "set-up", "random", "expert", "episodes"), references
        ),
    )
