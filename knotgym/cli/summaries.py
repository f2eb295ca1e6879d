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
    read_manifest,
    read_table,
    shards,
    show_episodes,
    state_card_tables,
)
from knotgym.prompting import show_transcripts
from knotgym.runs import narrow_table
from knotgym.states import read_states

_LISTED = 24  # entries of a mapping that are printed, at most
# paths stay whole, to be copied
_FACTS = TextWrapper(80, subsequent_indent=" " * 21, break_on_hyphens=False, break_long_words=False)


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
        if text := _in_words(value):
            for line in _FACTS.wrap(f"{name:20} {text}"):
                _say(console, line)


def _in_words(value: Any) -> str:
    """Format a value of a summary for reading; "" for None, "none" for one in a mapping."""
    if isinstance(value, Mapping):
        entries = [
            f"{name} {_in_words(one) or 'none'}" for name, one in list(value.items())[:_LISTED]
        ]
        more = len(value) - len(entries)
        return ", ".join(entries) + (f" and {more} more" if more else "")
    if isinstance(value, list):
        is_interval = bool(value) and isinstance(value[0], float)
        return (" to " if is_interval else " and ").join(map(_in_words, value))
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def _print_tables(tables: Mapping[str, CardTable], console: Console) -> None:
    for one in tables.values():
        if not one.rows:
            continue
        shown = narrow_table(one.head, title=one.title, left=one.left)
        for row in one.rows:
            shown.add_row(*map(str, row))
        console.print(shown)
        if one.says:
            _say(console, one.says)


def _say(console: Console, line: str) -> None:
    text = fill(line, 80, break_long_words=False, break_on_hyphens=False)
    console.print(text, highlight=False, markup=False, soft_wrap=True)
