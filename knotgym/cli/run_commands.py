"""The commands `knotgym generate` and `knotgym images`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    EXECUTION,
    EXISTING,
    RUN,
    Given,
    Option,
    command,
    default_folder,
    listed,
    numbers,
    option,
    options_of,
    run_options,
)
from knotgym.topology.gauss import GaussCode
from knotgym.topology.notation import parse_code

if TYPE_CHECKING:
    import numpy as np

HARD_UNKNOTS = "hard-unknots"  # the list of codes that ships
MOST_CODES = 100_000  # of a list; the states' provenance holds all of them
_CHOICE, _SEARCH, _SPLITS = "Which states", "The search", "Splits"


def _generate_options() -> list[Option]:
    from knotgym.generate.states.generate_config import GenerateConfig

    config = GenerateConfig()
    by_knot = {
        "default": None,
        "show_default": "3, or with --knot the crossing number of that knot",
    }
    return [
        *options_of(config, "nx count", nx=by_knot),
        option(
            "--out",
            Path,
            "Folder to write; by default knotgym-data/nx3, or nx3-3_1 with --knot 3_1.",
        ),
        *options_of(config, "source demonstrations every_code split_by knot", _CHOICE),
        option(
            "--codes",
            Path,
            "File of Gauss, PD or DT codes, one per line, or hard-unknots for the 21 diagrams of"
            " Burton and others. --nx chooses by crossings, --count at random; --every-code gives"
            " the number of states per code, 1 by default.",
            group=_CHOICE,
        ),
        *options_of(config, "attempts", _SEARCH),
        *options_of(config, "engine beads", ENVIRONMENT),
        *options_of(config, "seed", RUN),
        *run_options(f"{EXECUTION} shard {EXISTING}"),
    ]


@command(_generate_options)
def generate(given: Given) -> None:
    """Generate rope states with train and test splits, and demonstrations of their Gauss codes.

    Examples:

        knotgym generate --nx 3 --count 40

        knotgym generate --nx 4 --every-code 1

        knotgym generate --nx 7 --count 20 --no-demonstrations

        knotgym generate --knot 8_19 --count 4

        knotgym generate --nx 2-4 --source random-walk
    """
    from knotgym.common.streams import Stream, generator
    from knotgym.datasets.minari_dataset import loading_lines
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.state_recipe import make_states
    from knotgym.topology.knot_table import UNKNOT, diagram_of

    options, progress, source, knot = given.run, given.progress, given["source"], given["knot"]
    codes, every_code = given["codes"], given["every_code"]
    nx, usual = given.text("nx"), {}
    if nx is None:
        nx = str(diagram_of(knot).nx) if knot != UNKNOT else "3"
        usual["nx"] = numbers(nx)
    folder = given["out"] or default_folder(
        f"nx{nx}",
        "" if source == "drawing" else source,
        "" if knot == UNKNOT else knot,
        f"every{every_code}" if every_code else "",
        "" if given["split_by"] == "state" else f"by-{given['split_by']}",
        codes.stem if codes else "",
        "" if given["demonstrations"] else "states",
        "" if given["engine"] == "auto" else given["engine"],
        "" if given["beads"] == 100 else f"beads{given['beads']}",
        f"seed{given['seed']}" if given["seed"] else "",
    )
    more: dict[str, Any] = {}
    if codes is not None:
        wanted = numbers(nx) if "nx" in given.typed else None
        count = given["count"] if "count" in given.typed else None
        found = code_list(codes, wanted, count, generator(Stream.SELECTION, given["seed"], 2))
        more["nx"] = tuple(dict.fromkeys(code.nx for code in found))
        more["codes"] = [str(code) if code.chirality is None else code.chiral for code in found]
        more["every_code"] = every_code or 1
    config = given.config(GenerateConfig, more, usual=usual)
    made = make_states(config, folder, options, progress=progress)
    root = made / "minari"
    for dataset in sorted(root.glob("knotgym/*/demonstrations-v0"))[-1:]:
        shown = dataset.relative_to(root).as_posix()
        progress.say_how_to_load(loading_lines(shown, root))


def _images_options() -> list[Option]:
    from knotgym.generate.images.images_config import ImagesConfig
    from knotgym.rendering.appearance import VARIED

    def varied(text: str, name: str) -> tuple[str, ...]:
        return {"all": VARIED, "none": ()}.get(text) or listed(text, name) * (text != "none")

    def held(text: str, name: str) -> tuple[int, ...] | None:
        return None if text == "largest" else () if text == "none" else numbers(text, name)

    config = ImagesConfig()
    test_nx = {
        "default": "largest",
        "read": held,
        "help": 'Numbers of crossings held out for split test-nx; also "largest" or "none".',
    }
    return [
        *options_of(config, "nx count"),
        option(
            "--out", Path, "Folder to write; by default knotgym-data/images-nx0-4 for --nx 0-4."
        ),
        option("--archive", Path, "Start from the states in a run's archive.h5."),
        option(
            "--states", Path, "Start from a states.h5; without either, from the included states."
        ),
        *options_of(config, "test_nx test_share code_share", _SPLITS, test_nx=test_nx),
        *options_of(
            config,
            "appearance.style appearance.vary appearance.sizes",
            vary={"default": "none", "read": varied},
            sizes={"names": "--size"},
        ),
        *options_of(config, "engine", ENVIRONMENT),
        *options_of(config, "seed", RUN),
        *run_options(f"{EXECUTION} shard {EXISTING}"),
    ]


@command(_images_options)
def images(given: Given) -> None:
    """Generate labelled pictures for perception.

    Each comes with its Gauss code, crossings, rope coordinates and a grade of difficulty. Needs the
    extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128

        knotgym images --nx 3,4 --count 100 --style knotbench
    """
    from knotgym.generate.images.image_recipe import make_images
    from knotgym.generate.images.images_config import ImagesConfig

    archive, states, size = given["archive"], given["states"], given.text("appearance.sizes")
    folder = given["out"] or default_folder(
        f"images-nx{given.text('nx')}",
        made_from(archive or states),
        "" if given["engine"] == "mujoco" else given["engine"],
        "" if given["appearance.style"] == "published" else given["appearance.style"],
        "varied" if given["appearance.vary"] else "",
        "" if size == "128" else f"{size}px",
        f"seed{given['seed']}" if given["seed"] else "",
    )
    make_images(
        given.config(ImagesConfig),
        folder,
        given.run,
        archive=archive,
        states=states,
        progress=given.progress,
    )


def code_list(
    path: Path, nx: Sequence[int] | None, count: int | None, rng: np.random.Generator
) -> list[GaussCode]:
    """Read Gauss, PD or DT codes from a file, one per line; "#" begins a comment.

    Args:
        path: the file, of any size, or HARD_UNKNOTS for the one that ships.
        nx: keep codes with these numbers of crossings; all if None.
        count: keep a random sample of so many; all if None, up to MOST_CODES.
        rng: source of the sample.

    Raises:
        InvalidInput: a line is none of them.
    """
    if str(path) == HARD_UNKNOTS and not path.exists():
        path = Path(str(files("knotgym.topology") / "data/hard-unknots.txt"))
    if path.exists() and not path.is_file():
        raise typer.BadParameter(f"--codes {path} is not a regular file")
    kept: list[tuple[int, GaussCode]] = []  # line number, code
    seen = 0
    try:
        with open(path, encoding="utf-8") as lines:
            for number, line in enumerate(lines):
                text = line.partition("#")[0].strip()
                if not text or (nx is not None and (code := parse_code(text)).nx not in nx):
                    continue
                # reservoir sampling: line k stays with probability count / k, so that one pass
                # over a list of any length gives every code the same chance
                seen += 1
                place = len(kept) if count is None or seen <= count else int(rng.integers(seen))
                if count is not None and place >= count:
                    continue
                if place >= MOST_CODES:
                    raise typer.BadParameter(
                        f"--codes {path} has more than {MOST_CODES} codes; --count 1000 takes a"
                        " random sample of 1000"
                    )
                kept[place : place + 1] = [(number, parse_code(text) if nx is None else code)]
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"--codes {path} can't be read: {error}") from error
    if not kept:
        of = "" if nx is None else f" with nx {', '.join(map(str, nx))}"
        raise typer.BadParameter(f"--codes {path} contains no code{of}")
    return [code for _, code in sorted(kept, key=lambda one: one[0])]


def made_from(source: Path | None) -> str:
    """Return the mark of a run that starts from a file of another run.

    >>> made_from(Path("knotgym-data/nx3/archive.h5"))
    'from-nx3'
    """
    return "" if source is None else f"from-{source.absolute().parent.name}"
