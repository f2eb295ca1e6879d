"""The command `knotgym generate`."""

from collections.abc import Sequence
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from knotgym import datasets
from knotgym.cli.options import RUN, Given, Numbers, command, numbers
from knotgym.common import InvalidInput, Stream
from knotgym.generate import GenerateConfig
from knotgym.topology import UNKNOT, GaussCode, Knot, parse_codes

HARD_UNKNOTS = "hard-unknots"  # the list of codes that ships
MOST_CODES = 100_000  # of a list; the states' provenance holds all of them


@command({"": GenerateConfig}, f"count source every_code demonstrations knot engine {RUN}")
def generate(
    given: Given, *, nx: Numbers = None, out: Path | None = None, codes: Path | None = None
) -> None:
    """Generate rope states with train and test splits, and demonstrations of their Gauss codes.

    Examples:

        knotgym generate --nx 3 --count 40

        knotgym generate --nx 4 --every-code 1

        knotgym generate --nx 7 --count 20 --no-demonstrations

        knotgym generate --knot 8_19 --count 4

        knotgym generate --nx 0-3 --count 200 --source play

    Args:
        nx: Numbers of crossings: 3, 2,3 or 0-4; by default 3, or those of --knot.
        out: Folder to write; by default knotgym-data/nx3, or nx3-3_1 with --knot 3_1.
        codes: File of Gauss, PD or DT codes, one per line, or hard-unknots for the 21 diagrams of
            Burton and others. --nx chooses by crossings, --count at random; --every-code gives the
            number of states per code, 1 by default.
    """
    from knotgym.generate import make_states  # the simulator

    knot = given.get("knot")
    usual = str(Knot(knot).diagram.nx) if knot != UNKNOT else "3"
    marks = [f"nx{usual if nx is None else nx}", codes and codes.stem, knot != UNKNOT and knot]
    folder = given.folder(out, "-".join(str(mark) for mark in marks if mark))
    more: dict[str, Any] = {} if nx is None else {"nx": numbers(nx)}
    if codes is not None:
        count = given.get("count") if given.has("count") else None
        rng = Stream.SELECTION.generator(given.get("seed"), 2)
        listed = _code_list(codes, more.get("nx"), count, rng)
        more["nx"] = tuple(dict.fromkeys(code.nx for code in listed))
        more["codes"] = [str(code) if code.chirality is None else code.chiral for code in listed]
        more["every_code"] = given.get("every_code") or 1
    config = given.config(GenerateConfig, more, usual={"nx": numbers(usual)})
    root = make_states(config, folder, given.run, progress=given.progress) / "minari"
    for dataset in sorted(root.glob("knotgym/*/demonstrations-v0"))[-1:]:
        shown = dataset.relative_to(root).as_posix()
        lines = datasets.loading_lines(shown, root)
        given.progress.say("to load it:", *(f"    {line}" for line in lines))


def _code_list(
    path: Path, nx: Sequence[int] | None, count: int | None, rng: np.random.Generator
) -> list[GaussCode]:
    """Read Gauss, PD or DT codes from a file; see `parse_codes`.

    Args:
        path: the file, of at most MOST_CODES codes, or HARD_UNKNOTS for the one that ships.
        nx: keep codes with these numbers of crossings; all if None.
        count: keep a random sample of so many, in their order; all if None.
        rng: source of the sample.

    Raises:
        InvalidInput: the file can't be read, a line is no code, or no code is kept.
    """
    if str(path) == HARD_UNKNOTS and not path.exists():
        path = Path(str(files("knotgym.topology") / "data/hard-unknots.txt"))
    if path.exists() and not path.is_file():
        raise InvalidInput(f"--codes {path} is not a regular file")
    try:
        with open(path, encoding="utf-8-sig") as lines:
            listed = [*islice(parse_codes(lines), MOST_CODES + 1)]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"--codes {path} can't be read: {error}") from error
    except InvalidInput as error:
        raise InvalidInput(f"--codes {path}, {error}") from None
    if len(listed) > MOST_CODES:
        raise InvalidInput(f"--codes {path} has more than {MOST_CODES} codes: split it")
    chosen = [code for code in listed if nx is None or code.nx in nx]
    if not chosen:
        of = "" if nx is None else f" with nx {', '.join(map(str, nx))}"
        raise InvalidInput(f"--codes {path} contains no code{of}")
    if count is None or count >= len(chosen):
        return chosen
    return [chosen[row] for row in sorted(rng.choice(len(chosen), count, replace=False))]
