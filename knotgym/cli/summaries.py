"""Summaries that `knotgym dataset show` prints for states, pictures, episodes and transcripts."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill, wrap
from typing import Any

from rich.console import Console

from knotgym.datasets.cards.image_card import summary as image_summary
from knotgym.datasets.cards.state_card import (
    OVERLAP_HEAD,
    OVERLAP_SAYS,
    SPREAD_HEAD,
    SPREAD_SAYS,
    growth,
    known_and_accepted,
    most_first,
    overlap_rows,
    spread_rows,
)
from knotgym.datasets.cards.state_card import summary as state_summary
from knotgym.datasets.episode_verification import show_episodes
from knotgym.datasets.image_table import GRADES, shards
from knotgym.datasets.manifest_check import read_manifest, run_report
from knotgym.prompting.reading_scores import HEAD, ReadingScores
from knotgym.prompting.summary import summarize
from knotgym.prompting.transcripts import InvalidTranscript, read_transcripts, transcripts_at
from knotgym.runs.tables import narrow_table
from knotgym.states.state_file import read_states

_LISTED = 24  # entries of a mapping that are printed, at most


def print_states(path: str, file: Path, console: Console) -> None:
    """Print a summary of a state file and of the run in its folder's manifest.

    Args:
        path: as the user gave it.
        file: the state file.
        console: where to print.
    """
    states = read_states(file, images=False)
    facts = state_summary(states)
    report = run_report(read_manifest(file.parent)[0])
    existing = report.get("existing_codes", {})
    counts = narrow_table(
        ("nx", "states", "codes", "of", "chiral", "train", "test", "both", "c / a", "actions"),
    )
    _say(console, f"{path}: {len(states)} states")
    for nx, count in facts["nx"].items():
        counts.add_row(
            nx,
            str(count["states"]),
            str(count["codes"]),
            str(existing.get(nx) or "?"),
            str(count["codes_with_chirality"]),
            str(count["train"]),
            str(count["test"]),
            str(count["codes_in_both_splits"]),
            f"{count['positive_crossings']}/{count['negative_crossings']}",
            "/".join(map(str, count["actions_to_reach"])),
        )
    console.print(counts)
    if facts["sources"]:
        made = ", ".join(f"{policy} {count}" for policy, count in facts["sources"].items())
        _say(console, f"sources: {made}")
    _say(
        console,
        "of: existing Gauss codes; chiral: codes with chirality; both: codes in both splits;"
        " actions: fewest/median/most to reach a state",
    )
    shared = narrow_table(OVERLAP_HEAD, title="train and test")
    for row in overlap_rows(facts["nx"]):
        shared.add_row(*row)
    console.print(shared)
    _say(console, OVERLAP_SAYS)
    spread = narrow_table(SPREAD_HEAD, title="spread")
    for row in spread_rows(facts["nx"]):
        spread.add_row(*row)
    console.print(spread)
    _say(console, SPREAD_SAYS)
    quality = narrow_table(
        ("measure", "unit", "min", "median", "max"), title="quality", left=("measure", "unit")
    )
    for name, spread in facts["quality"].items():
        numbers = (f"{spread[key]:.3g}" for key in ("min", "median", "max"))
        quality.add_row(name, spread["unit"], *numbers)
    console.print(quality)
    _print_growth(report, console)
    _print_rejected(report, console)


def print_images(path: str, console: Console) -> None:
    """Print a summary of a perception table."""
    facts, size = image_summary(path), sum(shard.stat().st_size for shard in shards(path))
    _say(
        console,
        f"{path}: {facts['pictures']} pictures, {size / facts['pictures']:.0f} bytes each",
    )
    counts = narrow_table(("", "pictures", "codes", "chiral", "of a code", "accepted"), left=("",))
    grades = narrow_table(("", *GRADES), left=("",))
    own = {f"nx {nx}": count for nx, count in facts["nx"].items()}
    for name, count in (own | facts["splits"]).items():
        last_of_nx = name == [*own][-1]
        counts.add_row(
            name,
            str(count["pictures"]),
            str(count["codes"]),
            str(count["codes_with_chirality"]),
            "/".join(map(str, count["of_a_code"])),
            str(count["accepted"]),
            end_section=last_of_nx,
        )
        grades.add_row(name, *map(str, count["grade"].values()), end_section=last_of_nx)
    console.print(counts)
    _say(
        console,
        "chiral: codes with chirality; of a code: fewest/most pictures; accepted: within the"
        " quality limits of generated states",
    )
    console.print(grades)
    for name, (low, middle, high) in facts["quality"].items():
        _say(console, f"{name:24} 5 % {low:<9.3g} median {middle:<9.3g} 95 % {high:.3g}")
    _say(console, f"sizes {facts['sizes']}, colours {facts['colours']}")


def print_episodes(path: str, console: Console) -> None:
    """Print a summary of an episode file or a Minari dataset."""
    for name, value in show_episodes(path).items():
        text = _in_words(value)
        if text:
            lines = wrap(f"{name:20} {text}", 80, subsequent_indent=" " * 21)
            for line in lines:
                _say(console, line)


def print_transcripts(path: Path, console: Console) -> None:
    """Print totals of the transcripts in a file or a folder."""
    file = transcripts_at(path)
    found = [] if file is None else read_transcripts(file)
    if not found:
        raise InvalidTranscript(f"{path} contains no transcripts")
    config, facts = found[0]["config"], summarize(found)
    task = config.get("task")
    of = f"{task['task']} nx {task['nx']}, {task['split']}" if task else "pictures"
    _say(console, f"{config['chat']['model']}, mode {config['mode']}, {of}")
    if "episodes" in facts:
        low, high = (f"{100 * end:.1f}" for end in facts["interval"])
        _say(
            console,
            f"{'success':20} {100 * facts['success_rate']:.1f} % of {facts['episodes']} episodes"
            f" ({low} to {high} %); {facts['without_valid_answer']} had no valid answer",
        )
    else:
        table = narrow_table(HEAD, left=HEAD[:1])
        for row in ReadingScores.of(found).rows():
            table.add_row(*row)
        console.print(table)
    for name in ("answers", "retries"):
        _say(console, f"{name:20} {_in_words(facts[name]) or 'none'}")
    tokens = (facts["prompt_tokens"], facts["completion_tokens"])
    cost = "" if facts["cost"] is None else f", cost {facts['cost']:.4g}"
    _say(console, f"{'tokens':20} prompt {tokens[0]}, completion {tokens[1]}{cost}")


def _in_words(value: Any) -> str:
    """Format a value of a summary for reading; "" for None."""
    if isinstance(value, Mapping):
        entries = [f"{name} {_in_words(one)}" for name, one in list(value.items())[:_LISTED]]
        more = len(value) - len(entries)
        return ", ".join(entries) + (f" and {more} more" if more else "")
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


def _print_growth(report: Mapping[str, Any], console: Console) -> None:
    rows = growth(report)
    if not rows:
        return
    grown = narrow_table(("steps", *(f"nx {nx}" for nx in rows[-1]["known"])))
    _say(console, "growth: codes with an action sequence / states accepted")
    for row in rows:
        grown.add_row(str(row["steps"]), *known_and_accepted(row))
    console.print(grown)


def _print_rejected(report: Mapping[str, Any], console: Console) -> None:
    rejected = report.get("rejected", {})
    if not rejected:
        return
    _say(
        console,
        f"{report['attempts']} drawings or walks; rejections by reason (one can have several):",
    )
    for nx, reasons in rejected.items():
        counts = ", ".join(f"{reason} {count}" for reason, count in most_first(reasons))
        _say(console, f"  nx {nx}: {counts}")


def _say(console: Console, line: str) -> None:
    text = fill(line, 80, break_long_words=False, break_on_hyphens=False)
    console.print(text, highlight=False, markup=False, soft_wrap=True)
