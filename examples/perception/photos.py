"""Read Gauss codes off pictures of rope of any one colour, or train the network that does it.

    knotgym images --nx 1-6 --appearance photo --states bench --count 6000 --out photos
    python examples/perception/photos.py read photos --split test-code --page misread.png
    python examples/perception/photos.py train photos --minutes 60 --out strands

`read` uses the reader that ships, or `--weights FOLDER`. A code counts as read if it is the
picture's from some base point in one of the two directions, with its chirality. `train` draws new
photos of the ropes in split train while it trains, and writes such a folder. On one core it makes
about a thousandth of the steps of a GPU: the weights that ship took nine minutes of one.
"""

import argparse
import itertools
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("photos.py needs torch: pip install '.[torch,huggingface]'") from error
from numpy.typing import NDArray
from pictures import Misread, page, shown_rows
from strand_loss import strand_loss

from knotgym.datasets import decode, read_rows
from knotgym.learn import load_rope_reader, save_rope_reader
from knotgym.photos import StrandNetwork, photograph
from knotgym.topology import GaussCode, RopesCode, find_crossings

SIDE, PLACES, MOST = 256, 512, 12  # of a training picture: side, places on the line, crossings
Array = NDArray[np.float64]
Example = tuple[NDArray[np.uint8], Array, Array, Array]  # picture, and the targets of `strand_loss`


def read(given: argparse.Namespace) -> None:
    """Read pictures and print the share of right codes, overall and by factor."""
    reader = load_rope_reader(given.weights) if given.weights else load_rope_reader()
    rows, missed = list[dict[str, Any]](), list[Misread]()
    for row in shown_rows(given.folder, given.split, given.count):
        code, image = GaussCode.parse(row["gauss_code_chiral"]), decode(row["image"])
        found = reader.read(image, given.views)
        right = found.code is not None and found.code.smallest() == RopesCode.of(code).smallest()
        factors = {**row["appearance"], **(row.get("photo") or {})}
        numbers = {name: one for name, one in factors.items() if isinstance(one, int | float)}
        known = {"nx": code.nx, "right": right, "accepted": row["accepted"]}
        rows.append({**numbers, **known, "confidence": found.confidence})
        if not right:
            missed.append((image, str(code), str(found.code or found.reason)))
    print("nx  pictures   right  accepted  right   of confidence above 0.5   right")
    groups = sorted({row["nx"] for row in rows})
    for name, own in [*((nx, [r for r in rows if r["nx"] == nx]) for nx in groups), ("all", rows)]:
        good = [row for row in own if row["accepted"]]
        sure = [row for row in own if row["confidence"] > 0.5]
        cells = (f"{len(part):8} {share(part):6.1f} %" for part in (own, good, sure))
        print(f"{name:3} {'  '.join(cells)}")
    print("\nfactor         lowest fifth  highest fifth  spread")
    spread = []
    for name in sorted(set(rows[0]) - {"nx", "right", "accepted", "confidence", "seed"}):
        values = np.array([row[name] for row in rows], dtype=np.float64)
        low, high = np.quantile(values, (0.2, 0.8))
        ends = [
            [row for row, inside in zip(rows, side, strict=True) if inside]
            for side in (values <= low, values >= high)
        ]
        if low < high and all(ends):
            first, last = map(share, ends)
            spread.append((abs(first - last), name, first, last))
    for apart, name, low, high in sorted(spread, reverse=True):
        print(f"{name:14} {low:10.1f} % {high:12.1f} % {apart:7.1f}")
    if given.page and missed:
        page(missed, given.page)


def share(rows: list[dict[str, Any]]) -> float:
    return 100 * sum(row["right"] for row in rows) / max(1, len(rows))


def train(given: argparse.Namespace) -> None:
    """Train a network on photos drawn by worker processes, and write its weights."""
    rows = read_rows(given.folder, "train", ["points"])
    ropes = np.array([np.reshape(row["points"], (-1, 3)) for row in rows])
    torch.manual_seed(given.seed)
    network = StrandNetwork().to(given.device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-4)
    begin, step, kept = time.time(), 0, list[Example]()
    with get_context("spawn").Pool(given.workers, _take, (ropes,)) as pool:
        drawn = pool.imap_unordered(example, itertools.count(given.seed * 10**9))
        while (done := (time.time() - begin) / (60 * given.minutes)) < 1:
            kept += itertools.islice(drawn, given.new)
            kept = kept[-given.keep :]
            rate = 2e-3 * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * done)))
            for group in optimizer.param_groups:
                group["lr"] = rate
            picked = np.random.default_rng([given.seed, step]).integers(len(kept), size=given.batch)
            parts = zip(*(kept[k] for k in picked), strict=True)
            image, *true = (
                torch.from_numpy(np.stack(part)).to(given.device).float() for part in parts
            )
            loss = strand_loss(network, image.permute(0, 3, 1, 2), *true)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            step += 1
            if step % given.every == 0:
                print(f"{time.time() - begin:6.0f} s  step {step}  loss {loss.item():.3f}")
    save_rope_reader(network.cpu(), given.out, {"steps": step})


_ROPES: list[Array] = []


def _take(ropes: Array) -> None:
    _ROPES[:] = list(ropes)


def example(number: int) -> Example:
    """Draw a photo of a random rope, with heights switched in every other one."""
    rng = np.random.default_rng(number)
    while True:
        rope = _ROPES[rng.integers(len(_ROPES))] * (1.0, 1.0, rng.choice((-1.0, 1.0)))
        shot = photograph(rope, SIDE, rng)
        if shot is not None and shot.crossings.nx <= MOST:
            break
    line = shot.line.astype(np.float64)
    line[:, 2] *= shot.look.scale
    found = find_crossings(line * (1.0, -1.0, 1.0))
    crossings = np.zeros((MOST, 5))
    for k, place in enumerate(found.over_place[:MOST].astype(int)):
        step = line[(place + 1) % len(line)] - line[place]
        twice = 2 * np.arctan2(step[1], step[0])
        crossings[k] = *(found.position[k] * (1, -1)), np.cos(twice), np.sin(twice), 1
    base = np.zeros(5)
    if shot.look.marked:
        step = line[1, :2] - line[-1, :2]
        base[:] = *line[0, :2], *(step / np.hypot(*step)), 1
    return shot.image, evenly(line[:, :2]), crossings, base


def evenly(line: Array) -> Array:
    """Return PLACES places, evenly in the picture, along a closed line (n, 2)."""
    closed = np.concatenate([line, line[:1]])
    walked = np.append(0.0, np.cumsum(np.hypot(*np.diff(closed, axis=0).T)))
    at = np.arange(PLACES) * walked[-1] / PLACES
    return np.stack([np.interp(at, walked, closed[:, k]) for k in range(2)], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("read", help="read the pictures of a table")
    one.set_defaults(run=read)
    one.add_argument("folder", type=Path)
    one.add_argument("--split")
    one.add_argument("--count", type=int)
    one.add_argument("--views", type=int, default=8)
    one.add_argument("--weights", help="folder; by default those that ship")
    one.add_argument("--page", type=Path, help="file for a page of misread pictures")
    two = commands.add_parser("train", help="train on new photos of a table's ropes")
    two.set_defaults(run=train)
    two.add_argument("folder", type=Path)
    two.add_argument("--out", type=Path, required=True)
    two.add_argument("--minutes", type=float, default=60)
    two.add_argument("--batch", type=int, default=16)
    two.add_argument("--new", type=int, default=2, help="new photos a step")
    two.add_argument("--keep", type=int, default=20_000, help="photos to draw from again")
    two.add_argument("--every", type=int, default=20)
    two.add_argument("--workers", type=int, default=1)
    two.add_argument("--device", default="cpu")
    two.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
