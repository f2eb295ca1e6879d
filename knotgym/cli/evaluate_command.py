"""The commands `knotgym evaluate` and `knotgym compare`."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from knotgym import generate, runs
from knotgym.cli.options import RUN, Given, as_typed, command, field_help
from knotgym.common import InvalidInput, one_line
from knotgym.control import PolicyConfig
from knotgym.generate import PROTOCOLS, EvaluateConfig

Files = Annotated[
    list[Path] | None,
    Parameter(name="FILES", help="Files of `knotgym evaluate --record` or --out."),
]
Policies = Annotated[
    list[str] | None,
    Parameter(help=f"{field_help(PolicyConfig, 'policy')} May be repeated; random by default."),
]


@command(
    {"": EvaluateConfig, "policy": PolicyConfig},
    f"tasks=--task nx splits=--split episodes protocol task.states task.engine failures {RUN}",
    lines=False,
)
def evaluate(
    given: Given,
    *,
    policy: Policies = None,
    out: Path | None = None,
    video: Path | None = None,
    record: Path | None = None,
) -> None:
    """Measure the success rates of policies, with 95 % confidence intervals.

    Every combination of policy, task, split and number of crossings is one row. What isn't given of
    task, nx, states and engine is taken from what a learner among the policies was trained on.

    Examples:

        knotgym evaluate --task tie --nx 3 --policy random --episodes 256

        knotgym evaluate --policy random --policy mine:act --task tie --nx 2-4

        knotgym evaluate --protocol code --policy mine:act --record mine.h5

    Args:
        out: JSON file to write.
        video: Film of the first episodes of each setup, or with --failures of the first that
            failed: .gif, or with the extra video .mp4 or .webm.
        record: Entry to write: every pull, so that `knotgym dataset verify` replays the score.
    """

    names = policy or ["random"]
    more = _trained_on(given, names)
    if policy or given.has("policy"):
        more["policies"] = [
            given.config(PolicyConfig, {"policy": name}, section="policy") for name in names
        ]
    protocol = given.get("protocol")
    tasks = given.get("tasks")
    usual = EvaluateConfig.of_protocol(protocol, tasks) if protocol in PROTOCOLS else {}
    config = given.config(EvaluateConfig, more, usual=usual)
    files = {"out": out, "video": video, "record": record}
    generate.evaluate(config, given.run, **files, progress=given.progress)


@command({}, "")
def compare(given: Given, files: Files = None, /) -> None:
    """Compare results: differences of success rates with intervals.

    For each task, number of crossings and split, every result is compared with the first one, and
    paired by episode where starts are the same. "better" is the probability that it has the higher
    rate on new states. Entries (--record) are replayed first.

    Examples:

        knotgym compare clone.h5 random.h5
    """

    if not files:
        raise InvalidInput("name files of `knotgym evaluate --record` or --out")
    runs.compile_first(given.progress)
    generate.compare(files, given.progress.console)


def _trained_on(given: Given, policies: list[str]) -> dict[str, Any]:
    """Return what all learners were trained on, of the settings that weren't given."""
    cards = [card for name in policies if (card := PolicyConfig(policy=name).card()) is not None]
    setups = [setup for card in cards if isinstance(setup := card.get("trained_on"), dict)]
    trained: dict[str, Any] = {}
    for path in ("tasks", "nx", "task.states", "task.engine"):
        _, is_single, name = path.rpartition(".")
        values: list[Any] = [setup.get(name) for setup in setups]
        first: Any = values[0] if values and values.count(values[0]) == len(values) else None
        count = len(first) if isinstance(first, list) and not given.has(path) else 0
        if count == 1 or (count and not is_single):
            trained[path] = first[0] if is_single else tuple(first)
    if trained:
        shown = (f"{path.rpartition('.')[2]} {as_typed(value)}" for path, value in trained.items())
        given.progress.say(one_line(f"as the learner was trained: {', '.join(shown)}"))
    return trained
