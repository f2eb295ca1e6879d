"""Options that several commands share, each declared once, in the groups that --help shows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from knotgym.configuration import Config, InvalidConfig, read_json, updated
from knotgym.runs.executors import scheduler_of
from knotgym.runs.run_options import Existing, RunOptions
from knotgym.runs.shards import Shard
from knotgym.topology.gauss import GaussCode

ENVIRONMENT, ACTING = "The environment", "Who acts"
RUN, METADATA = "How it is run", "Metadata"
_POLICIES = (
    "random, constant, scripted, expert, noisy-expert, mixed, pretrained; the folder of a learner"
    " (knotgym train); a .zip (SB3), .onnx or .pt file; prompt:FILE, transcripts of `knotgym"
    " prompt`; or module:name of your own, a function of (observation) or (observation, info,"
    " generator), or an object with reset and act."
)


def option(*names: str, help: str, group: str | None = None, **more: Any) -> Any:
    """An option of a group of --help."""
    return typer.Option(*names, help=help, rich_help_panel=group, **more)


NxOption = Annotated[str, option("--nx", help="Crossings: 3, or 2,3, or 0-4.")]

StatesOption = Annotated[
    Path | None,
    option(
        "--states",
        help="readable (default), random-walk or hard-unknots, which ship, or a state file, or the"
        " folder of the run that made it.",
        group=ENVIRONMENT,
    ),
]
ObservationOption = Annotated[
    str, option("--observation", help="pixels, state, both or symbolic.", group=ENVIRONMENT)
]
MaxGoalsOption = Annotated[
    int | None,
    option(
        "--max-goals",
        help="So many goal configurations of the split at most, the first by row; all by default.",
        group=ENVIRONMENT,
    ),
]
ImageSizeOption = Annotated[
    int, option("--image-size", help="Pixels, each half of the picture.", group=ENVIRONMENT)
]
ViewsOption = Annotated[
    str,
    option(
        "--views",
        help="Views in the picture, with commas: of top, left and front.",
        group=ENVIRONMENT,
    ),
]
DepthOption = Annotated[
    bool, option("--depth", help="Depth as a fourth channel of the picture.", group=ENVIRONMENT)
]
HorizonOption = Annotated[
    int, option("--horizon", help="Steps until truncation.", group=ENVIRONMENT)
]
HoldOption = Annotated[
    int,
    option("--hold", help="Consecutive steps the goal code must show.", group=ENVIRONMENT),
]
TowLimitOption = Annotated[
    float | None,
    option(
        "--tow-limit",
        help="Metres that the rope's centre may be towed; no bound by default.",
        group=ENVIRONMENT,
    ),
]
ResetNoiseOption = Annotated[
    float,
    option(
        "--reset-noise",
        help="Scale of the noise at reset, radians per joint and metres.",
        group=ENVIRONMENT,
    ),
]
IntegratorStepsOption = Annotated[
    int,
    option(
        "--integrator-steps",
        help="MuJoCo steps in an action; 20 are faster, on slightly other trajectories.",
        group=ENVIRONMENT,
    ),
]

PolicyOption = Annotated[str, option("--policy", help=_POLICIES, group=ACTING)]
PoliciesOption = Annotated[
    list[str] | None, option("--policy", help=f"{_POLICIES} May be repeated.", group=ACTING)
]
NoiseOption = Annotated[
    float,
    option("--noise", help="Chance that a noisy expert's pull is a random one.", group=ACTING),
]
BudgetOption = Annotated[
    int,
    option("--budget", help="Actions that an expert may simulate for an episode.", group=ACTING),
]
SharesOption = Annotated[
    str,
    option("--shares", help="Of random, scripted, noisy-expert and expert in mixed.", group=ACTING),
]

SeedOption = Annotated[
    int,
    option("--seed", help="Of everything; the same seed gives the same bytes.", group=RUN),
]
WorkersOption = Annotated[
    int,
    option("--workers", help="Processes; 0 for one a core. Does not change the result.", group=RUN),
]
EngineOption = Annotated[
    str,
    option(
        "--engine",
        help=(
            "local, or dask: the workers of a Dask cluster, on a file system that all of them see"
            " (extra dask)."
        ),
        group=RUN,
    ),
]
SchedulerOption = Annotated[
    str,
    option(
        "--scheduler",
        help="Address of the cluster's scheduler, such as tcp://127.0.0.1:8786.",
        group=RUN,
    ),
]
ShardOption = Annotated[
    str,
    option(
        "--shard",
        help=(
            "2/8: make the second eighth of the run, in NAME-shard-2-of-8; `knotgym dataset merge`"
            " puts all eight together."
        ),
        group=RUN,
    ),
]
SettingsOption = Annotated[
    Path | None,
    option(
        "--settings",
        help="JSON file of further settings, named as `config` in manifest.json names them.",
        group=RUN,
    ),
]
ResumeOption = Annotated[bool, option("--resume", help="Finish an interrupted run.", group=RUN)]
RestartOption = Annotated[
    bool,
    option(
        "--restart",
        help="Throw away what an interrupted run left, and start from the beginning.",
        group=RUN,
    ),
]
OverwriteOption = Annotated[
    bool,
    option(
        "--overwrite",
        help="Replace an output that exists, once the new one is complete.",
        group=RUN,
    ),
]
QuietOption = Annotated[bool, option("--quiet", help="Say nothing but errors.", group=RUN)]


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
    """The Gauss codes in a file, one a line; none of no file.

    Raises:
        InvalidGaussCode: a line is none.
    """
    if path is None:
        return []
    if path.exists() and not path.is_file():
        raise typer.BadParameter(f"--codes {path} is no regular file")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"--codes {path} can't be read: {error}") from error
    found = [GaussCode.parse(line) for line in lines if line.strip()]
    if not found:
        raise typer.BadParameter(f"--codes {path} holds no code")
    return found


def listed(text: str) -> tuple[str, ...]:
    """Read "top,left"."""
    return tuple(word.strip() for word in text.split(","))


def words(text: str) -> tuple[str, ...]:
    """Read "tie,unknot", each once."""
    return tuple(dict.fromkeys(listed(text)))


def run_options(
    engine: str, scheduler: str, workers: int, shard: str, existing: Existing, quiet: bool
) -> RunOptions:
    """What the options of a run say together."""
    return RunOptions(
        workers=workers,
        scheduler=scheduler_of(engine, scheduler, workers),
        shard=Shard.parse(shard),
        quiet=quiet,
        **vars(existing),
    )


def default_folder(name: str, *marks: str) -> Path:
    """Where a run goes without --out: its name, and what tells it from other runs of that name.

    >>> print(default_folder("nx3", "3_1", "", "seed1"))
    knotgym-data/nx3-3_1-seed1
    """
    return Path("knotgym-data") / "-".join([name.replace(" ", ""), *filter(None, marks)])


def made_from(source: Path | None) -> str:
    """A mark for a run that sets out from a file of another run's folder.

    >>> made_from(Path("knotgym-data/nx3/archive.h5"))
    'from-nx3'
    """
    return "" if source is None else f"from-{source.absolute().parent.name}"


def with_settings(config: Config, path: Path | None) -> Config:
    """A configuration changed by a --settings file.

    Raises:
        InvalidConfig: the file can't be read as JSON, or names what isn't there.
    """
    if path is None:
        return config
    try:
        changes = read_json(path)
    except (OSError, ValueError) as error:
        raise InvalidConfig(f"--settings {path} can't be read as JSON: {error}") from error
    return updated(config, changes)
