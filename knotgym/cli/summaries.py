"""Summaries that `knotgym dataset show` prints for states, pictures, episodes and transcripts."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from textwrap import TextWrapper, fill
from typing import Any

from rich.console import Console

from knotgym.datasets import (
    CardTable,
    image_card_tables,
    in_words,
    read_manifest,
    read_table,
    shards,
    show_episodes,
    state_card_tables,
)
from knotgym.prompting import show_transcripts
from knotgym.runs import narrow_table
from knotgym.states import read_states

_WIDTH, _GAP = 80, 3  # characters of a line, and between columns
# paths stay whole, to be copied
_FACTS = TextWrapper(
    _WIDTH, subsequent_indent=" " * 21, break_on_hyphens=False, break_long_words=False
)


def print_states(path: str, file: Path, console: Console) -> None:
    """Print a summary of a state file and of the run in its folder's manifest."""
    states = read_states(file, images=False)
    report = read_manifest(file.parent)[0].get("report", {})
    _say(console, f"{path}: {len(states)} states")
    if "policy" in states.source:
        made = sorted(Counter(states.source["policy"].tolist()).items())
        _say(console, f"sources: {', '.join(f'{policy} {count}' for policy, count in made)}")
    _print_tables(state_card_tables(states, report), console)


def print_images(path: Path, console: Console) -> None:
    """Print a summary of a perception table."""
    size = sum(shard.stat().st_size for shard in shards(path))
    count = len(read_table(path, columns=["nx"]))
    _say(console, f"{path}: {count} pictures, {size / count:.0f} bytes each")
    _print_tables(image_card_tables(path), console)


def print_episodes(path: Path, console: Console) -> None:
    """Print a summary of an episode file or a Minari dataset."""
    _print_facts(show_episodes(path), console)


def print_transcripts(path: str | Path, console: Console) -> bool:
    """Print totals of the transcripts in a file or a folder; return whether it has any."""
    found = show_transcripts(path)
    if found is None:
        return False
    facts, rows = found
    _print_facts(facts, console)
    if rows:
        table = narrow_table(rows[0], left=rows[0][:1])
        for row in rows[1:]:
            table.add_row(*row)
        console.print(table)
    return True


def _print_facts(facts: Mapping[str, Any], console: Console) -> None:
    """Print a line for each fact that is known."""
    for name, value in facts.items():
        if text := in_words(value):
            for line in _FACTS.wrap(f"{name:20} {text}"):
                _say(console, line)


def _print_tables(tables: Mapping[str, CardTable], console: Console) -> None:
    for one in tables.values():
        if not one.rows:
            continue
        title: str | None = one.title
        for chosen in _parts(one):
            shown = narrow_table([one.head[k] for k in chosen], title=title, left=one.left)
            for row in one.rows:
                shown.add_row(*(str(row[k]) for k in chosen))
            console.print(shown)
            title = None
        if one.says:
            _say(console, one.says)


def _parts(table: CardTable) -> list[list[int]]:
    """Deal the columns of a table to parts of 80 characters, each of which repeats the first."""
    cells = zip(*([table.head, *table.rows]), strict=True)
    widths = [max(len(str(cell)) for cell in column) + _GAP for column in cells]
    parts = [[0]]
    for k, width in enumerate(widths[1:], 1):
        if len(parts[-1]) > 1 and sum(widths[one] for one in parts[-1]) + width > _WIDTH:
            parts.append([0])
        parts[-1].append(k)
    return parts


def _say(console: Console, line: str) -> None:
    text = fill(line, _WIDTH, break_long_words=False, break_on_hyphens=False)
    console.print(text, highlight=False, markup=False, soft_wrap=True)
