"""Options shared by several commands, declared once, in the groups that --help shows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from knotgym.common.configuration import Config, InvalidConfig, read_json, updated
from knotgym.runs.executors import scheduler_of
from knotgym.runs.run_options import Existing, RunOptions
from knotgym.runs.shards import Shard
from knotgym.topology.gauss import GaussCode

ENVIRONMENT, ACTING = "The environment", "Who acts"
RUN, METADATA = "How it is run", "Metadata"
_POLICIES = (
    "random, constant, scripted, expert, noisy-expert, mixed or pretrained; a folder written by"
    " `knotgym train`; a .zip (SB3), .onnx or .pt file; prompt:FILE, to score transcripts of"
    " `knotgym prompt`; or module:name for your own code: a function of (observation) or"
    " (observation, info, generator), or an object with reset and act."
)


def option(*names: str, help: str, group: str | None = None, **more: Any) -> Any:
    """Declare an option in a --help group."""
    return typer.Option(*names, help=help, rich_help_panel=group, **more)


NxOption = Annotated[str, option("--nx", help="Numbers of crossings: 3, 2,3 or 0-4.")]

StatesOption = Annotated[
    Path | None,
    option(
        "--states",
        help="Set of states: readable (default), random-walk or hard-unknots, which are included;"
        " or a state file, or the folder of the run that made it.",
        group=ENVIRONMENT,
    ),
]
ObservationOption = Annotated[
    str,
    option(
        "--observation", help="Observation: pixels, state, both or symbolic.", group=ENVIRONMENT
    ),
]
MaxGoalsOption = Annotated[
    int | None,
    option(
        "--max-goals",
        help="Use only the first N goal states of the split, in file order; all by default.",
        group=ENVIRONMENT,
    ),
]
ImageSizeOption = Annotated[
    int,
    option(
        "--image-size",
        help="Side of each half of the picture (rope and goal), in pixels.",
        group=ENVIRONMENT,
    ),
]
ViewsOption = Annotated[
    str,
    option(
        "--views",
        help="Camera views in the picture, comma-separated: top, left, front.",
        group=ENVIRONMENT,
    ),
]
DepthOption = Annotated[
    bool, option("--depth", help="Add depth as a fourth image channel.", group=ENVIRONMENT)
]
HorizonOption = Annotated[
    int, option("--horizon", help="Steps before an episode is truncated.", group=ENVIRONMENT)
]
HoldOption = Annotated[
    int,
    option(
        "--hold",
        help="Consecutive steps that the rope must show the goal code.",
        group=ENVIRONMENT,
    ),
]
TowLimitOption = Annotated[
    float | None,
    option(
        "--tow-limit",
        help="Furthest that the rope's centre may be towed, in metres; no limit by default.",
        group=ENVIRONMENT,
    ),
]
ResetNoiseOption = Annotated[
    float,
    option(
        "--reset-noise",
        help="Scale of the noise added at reset, in radians per joint and in metres.",
        group=ENVIRONMENT,
    ),
]
EngineOption = Annotated[
    str,
    option(
        "--engine",
        help="Simulation engine: mujoco, the reference, or chain, which is many times as fast.",
        group=ENVIRONMENT,
    ),
]
IntegratorStepsOption = Annotated[
    int,
    option(
        "--integrator-steps",
        help="MuJoCo steps per action; 20 is faster and gives slightly different trajectories.",
        group=ENVIRONMENT,
    ),
]

PolicyOption = Annotated[str, option("--policy", help=_POLICIES, group=ACTING)]
PoliciesOption = Annotated[
    list[str] | None, option("--policy", help=f"{_POLICIES} May be repeated.", group=ACTING)
]
NoiseOption = Annotated[
    float,
    option(
        "--noise",
        help="Probability that noisy-expert takes a random action instead of its own.",
        group=ACTING,
    ),
]
BudgetOption = Annotated[
    int,
    option("--budget", help="Simulated actions per episode for expert planning.", group=ACTING),
]
SharesOption = Annotated[
    str,
    option(
        "--shares",
        help="Shares of random, scripted, noisy-expert and expert episodes in mixed.",
        group=ACTING,
    ),
]

SeedOption = Annotated[
    int,
    option("--seed", help="Random seed; the same seed gives the same bytes.", group=RUN),
]
WorkersOption = Annotated[
    int,
    option(
        "--workers",
        help="Worker processes; 0 for one per core. Doesn't change the result.",
        group=RUN,
    ),
]
ExecutorOption = Annotated[
    str,
    option(
        "--executor",
        help=(
            "What runs the work: local processes, or dask for a Dask cluster whose workers share a"
            " file system (needs the extra dask)."
        ),
        group=RUN,
    ),
]
SchedulerOption = Annotated[
    str,
    option(
        "--scheduler",
        help="Address of the Dask scheduler, such as tcp://127.0.0.1:8786.",
        group=RUN,
    ),
]
ShardOption = Annotated[
    str,
    option(
        "--shard",
        help=(
            "2/8 makes the second eighth of the run, in NAME-shard-2-of-8; `knotgym dataset merge`"
            " joins all eight."
        ),
        group=RUN,
    ),
]
SettingsOption = Annotated[
    Path | None,
    option(
        "--settings",
        help="JSON file with more settings, using the names of `config` in manifest.json.",
        group=RUN,
    ),
]
ResumeOption = Annotated[bool, option("--resume", help="Finish an interrupted run.", group=RUN)]
RestartOption = Annotated[
    bool,
    option(
        "--restart",
        help="Delete the work of an interrupted run and start again.",
        group=RUN,
    ),
]
OverwriteOption = Annotated[
    bool,
    option(
        "--overwrite",
        help="Replace an existing output once the new one is complete.",
        group=RUN,
    ),
]
QuietOption = Annotated[bool, option("--quiet", help="Print errors only.", group=RUN)]


def numbers(text: str) -> tuple[int, ...]:
    """Read "3", "2,3" or "0-4".

    >>> numbers("0-2,4")
    (0, 1, 2, 4)
    """
    out: list[int] = []
    for word in text.split(","):
        low, dash, high = word.strip().partition("-")
        if (
            not low.isdecimal()
            or (dash and not high.isdecimal())
            or len(word.strip()) > 5
            or (dash and int(high) < int(low))
        ):
            raise typer.BadParameter(
                f"--nx takes numbers of crossings such as 3, 2,3 or 0-4, got {text!r}"
            )
        out += range(int(low), int(high if dash else low) + 1)
    if len(set(out)) < len(out):
        raise typer.BadParameter(f"--nx takes each number once, got {text!r}")
    return tuple(out)


def code_list(path: Path | None) -> list[GaussCode]:
    """Read Gauss codes from a file, one per line; an empty list without a file.

    Raises:
        InvalidGaussCode: a line is not a Gauss code.
    """
    if path is None:
        return []
    if path.exists() and not path.is_file():
        raise typer.BadParameter(f"--codes {path} is not a regular file")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"--codes {path} can't be read: {error}") from error
    found = [GaussCode.parse(line) for line in lines if line.strip()]
    if not found:
        raise typer.BadParameter(f"--codes {path} contains no Gauss code")
    return found


def listed(text: str) -> tuple[str, ...]:
    """Split "top,left" at its commas."""
    return tuple(word.strip() for word in text.split(","))


def words(text: str) -> tuple[str, ...]:
    """Split "tie,unknot" at its commas and drop duplicates."""
    return tuple(dict.fromkeys(listed(text)))


def run_options(
    executor: str, scheduler: str, workers: int, shard: str, existing: Existing, quiet: bool
) -> RunOptions:
    """Build the options of a run from the command line."""
    return RunOptions(
        workers=workers,
        scheduler=scheduler_of(executor, scheduler, workers),
        shard=Shard.parse(shard),
        quiet=quiet,
        **vars(existing),
    )


def default_folder(name: str, *marks: str) -> Path:
    """Return the output folder used without --out: a name and marks for non-default settings.

    >>> print(default_folder("nx3", "3_1", "", "seed1"))
    knotgym-data/nx3-3_1-seed1
    """
    return Path("knotgym-data") / "-".join([name.replace(" ", ""), *filter(None, marks)])


def made_from(source: Path | None) -> str:
    """Return the mark of a run that starts from a file of another run.

    >>> made_from(Path("knotgym-data/nx3/archive.h5"))
    'from-nx3'
    """
    return "" if source is None else f"from-{source.absolute().parent.name}"


def with_settings(config: Config, path: Path | None) -> Config:
    """Apply a --settings file to a configuration.

    Raises:
        InvalidConfig: the file can't be read as JSON or names an unknown setting.
    """
    if path is None:
        return config
    try:
        changes = read_json(path)
    except (OSError, ValueError) as error:
        raise InvalidConfig(f"--settings {path} can't be read as JSON: {error}") from error
    return updated(config, changes)
