"""How far ropes drawn from codes reach beyond the codes that are listed.

    python benchmarks/drawn.py crossings --nx 7 8 9 10 --codes 100 --page drawn-7-10.png
    python benchmarks/drawn.py knots --drawings 60

`crossings` draws --codes codes of each --nx, uniformly at random among those of unknots, each
--drawings times or until a state is accepted by the limits of pictures of 128 pixels. A drawing is
also judged for 256 pixels, where half the width tells a gap from none: two strands lie a rope's
width and one of those pixels apart, two crossings two widths and one of them, a region is three of
them wide; all other limits stay.

`knots` lays every prime knot of up to ten crossings from its table's diagram, begun at any base
point and seen from either side: rests with the code unchanged, read by both labellers, of the knot
and of its hand, clear of itself by 8 mm and the code kept in 95 % of draws of reset noise. Nothing
is asked of its picture.

Writes JSON to --out after every code; the same command goes on after the last one there.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from knotgym.common.atomic_files import atomic_write
from knotgym.datasets.gallery import Tile, contact_sheet, write_png
from knotgym.generate.states.drawn_states import DrawnUnit, draw_states
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.quality.measures import Limits
from knotgym.rendering.diagram import draw_diagram
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, based_diagrams, prime_diagrams
from knotgym.topology.knots import is_unknot, shows
from knotgym.topology.uniform_codes import uniform_code

AT_256 = Limits(crossing_spacing=4.5, strand_spacing=2.5, smallest_region=2.25)
LAID = Limits(
    crossing_angle=0,
    crossing_spacing=0,
    base_spacing=0,
    strand_spacing=0,
    smallest_region=0,
    margin=-1000,
    excess_crossing_number=1000,
    total_curvature=1000,
)
SHOWN = 8  # states of each nx on the page


def crossings_row(code: GaussCode, number: int, drawings: int, seed: int) -> dict[str, Any]:
    """What becomes of a code: the first state accepted at either size, and what rejects at 128."""
    config = GenerateConfig(nx=(code.nx,), seed=seed, limits=AT_256)
    row: dict[str, Any] = {"code": str(code), "nx": code.nx, "drawings": 0, "at_256": False}
    row |= {"at_128": False, "rejected": {}}
    rejected: Counter[str] = Counter()
    while row["drawings"] < drawings and not row["at_128"]:
        unit = DrawnUnit(
            config, UNKNOT, code, number, row["drawings"], drawings - row["drawings"], 1
        )
        made = draw_states(unit)
        row["drawings"] += made.drawings
        rejected += made.rejected
        for state in made.states:
            faults = Limits().faults(state.quality, code.nx)
            if not row["at_256"] or not faults:
                row["points"] = np.round(state.points, 6).tolist()
            row |= {"at_256": True, "at_128": not faults}
            rejected.update(f"{fault}, at 128 alone" for fault in faults)
    return row | {"rejected": dict(rejected.most_common())}


def unknot_codes(nx: int, count: int, seed: int) -> Iterator[GaussCode]:
    """Different codes without chirality, each of those of an unknot equally likely."""
    rng = np.random.default_rng([seed, nx])
    given: set[GaussCode] = set()
    while len(given) < count:
        code = uniform_code(nx, rng)
        if is_unknot(code) and code not in given:
            given.add(code)
            yield code


def knot_row(name: str, number: int, drawings: int, seed: int) -> dict[str, Any]:
    """Whether one of so many drawings of a knot is laid."""
    diagrams = based_diagrams(prime_diagrams()[name])
    rng = np.random.default_rng([seed, number])
    nx = diagrams[0].nx
    config = GenerateConfig(nx=(nx,), knot=name, seed=seed, limits=LAID)
    rejected: Counter[str] = Counter()
    for drawing in range(drawings):
        code = diagrams[int(rng.integers(len(diagrams)))]
        made = draw_states(DrawnUnit(config, name, code, number, drawing, 1, 1))
        rejected += made.rejected
        if made.states:
            assert shows(made.states[0].code, name)
            return {"knot": name, "laid": True, "drawings": drawing + 1}
    return {"knot": name, "laid": False, "drawings": drawings, "rejected": dict(rejected)}


def page(rows: list[dict[str, Any]]) -> NDArray[np.uint8]:
    """States accepted, SHOWN of each nx."""
    tiles = []
    for nx in sorted({row["nx"] for row in rows}):
        kept = [row for row in rows if row["nx"] == nx and "points" in row]
        for row in kept[:SHOWN]:
            caption = f"nx {nx}, {'128' if row['at_128'] else '256'} pixels"
            tiles.append(Tile(draw_diagram(row["points"]), (caption,)))
    return contact_sheet(tiles, columns=SHOWN)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["crossings", "knots"])
    parser.add_argument("--nx", type=int, nargs="+", default=[7, 8, 9, 10])
    parser.add_argument("--codes", type=int, default=100, help="of each nx")
    parser.add_argument(
        "--knots",
        nargs="+",
        choices=[*prime_diagrams()],
        metavar="NAME",
        help="all 249 if not told",
    )
    parser.add_argument("--drawings", type=int, default=10, help="of each code or knot, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", type=Path, default=None, help="PNG of accepted states")
    parser.add_argument("--out", type=Path, default=None, help="drawn-WHAT.json if not told")
    asked = parser.parse_args()
    out = asked.out or Path(f"drawn-{asked.what}.json")
    settings = {"what": asked.what, "drawings": asked.drawings, "seed": asked.seed}
    report: dict[str, Any] = {"settings": settings, "rows": {}}
    if out.exists():
        report = json.loads(out.read_text(encoding="utf-8"))
        if report["settings"] != settings:
            parser.error(f"{out} was made with {report['settings']}")
    rows = report["rows"]
    todo: list[tuple[str, Callable[[int, int], dict[str, Any]]]]
    if asked.what == "knots":
        numbers = {name: number for number, name in enumerate(prime_diagrams())}
        todo = [(name, partial(knot_row, name, numbers[name])) for name in asked.knots or numbers]
    else:
        todo = [
            (f"{nx} {code}", partial(crossings_row, code, number))
            for nx in asked.nx
            for number, code in enumerate(unknot_codes(nx, asked.codes, asked.seed))
        ]
    for key, make in todo:
        if key in rows:
            continue
        begun = time.process_time()
        rows[key] = make(asked.drawings, asked.seed)
        rows[key]["cpu_seconds"] = round(time.process_time() - begun, 2)
        with atomic_write(out) as temporary:
            temporary.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    kept = [rows[key] for key, _ in todo]
    if asked.what == "knots":
        groups, counted = {"all": kept}, {"laid": "laid"}
        print("not laid:", *[row["knot"] for row in kept if not row["laid"]] or ["none"])
    else:
        groups = {f"nx {nx}": [row for row in kept if row["nx"] == nx] for nx in asked.nx}
        counted = {"at_128": "accepted at 128", "at_256": "accepted at 256"}
        if asked.page and any("points" in row for row in kept):
            write_png(asked.page, page(kept))
    table = Table(title=f"{asked.what}: at most {asked.drawings} drawings each")
    counted |= {"drawings": "drawings", "cpu_seconds": "CPU s"}
    for name in ("", "knots" if asked.what == "knots" else "codes", *counted.values()):
        table.add_column(name)
    for name, own in groups.items():
        sums = [f"{sum(row[column] for row in own):.0f}" for column in counted]
        table.add_row(name, f"{len(own)}", *sums)
    Console().print(table)


if __name__ == "__main__":
    main()
