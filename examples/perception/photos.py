"""Read Gauss codes off pictures of rope of any one colour, or train the network that does it.

    knotgym images --nx 1-6 --appearance photo --states bench --count 6000 --out photos
    python examples/perception/photos.py read photos --split test-code --page misread.png
    python examples/perception/photos.py train --minutes 60 --out strands
    python examples/perception/photos.py train --start rope-reader --rate 4e-4 --minutes 8 --out own

`read` uses the reader that ships, or `--weights FOLDER`. A code counts as read if it is the
picture's from some base point in one of the two directions, with its chirality. `train` draws new
photos of both looks of the ropes in split train while it trains, and writes such a folder, from
nothing or from a reader that exists; started again, it goes on. A step of 16 pictures takes two CPU
seconds: training from nothing is for a GPU (`--device cuda`), of which the first weights took nine
minutes.
"""

import argparse
import copy
import math
import time
from pathlib import Path
from typing import Any
from zlib import crc32

import cv2
import numpy as np

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("photos.py needs torch: pip install '.[torch,huggingface]'") from error
from numpy.typing import NDArray
from pictures import Misread, page, shown_rows
from strand_loss import strand_loss
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from knotgym.datasets import decode
from knotgym.learn import load_rope_reader, save_rope_reader
from knotgym.photos import PhotoReading, StrandNetwork, photograph
from knotgym.rendering import AppearanceConfig
from knotgym.states import read_states, shipped
from knotgym.topology import GaussCode, RopesCode, Symmetry, canonical, find_ropes_crossings, label

SIDE, PLACES, MOST = 256, 512, 12  # of a training picture: side, places on the line, crossings
PARTS = 4  # pictures that are in the network at once
CLEAR = 16  # pixels between a part without a rope and the line of any
Array = NDArray[np.float64]
Example = tuple[NDArray[np.uint8], Array, Array]  # picture, and the targets of `strand_loss`


def read(given: argparse.Namespace) -> None:
    """Read pictures and print the share of right codes, overall and by factor."""
    reader = load_rope_reader(given.weights) if given.weights else load_rope_reader()
    rows, missed = list[dict[str, Any]](), list[Misread]()
    for row in shown_rows(given.folder, given.split, given.count):
        code, image = GaussCode.parse(row["gauss_code_chiral"]), decode(row["image"])
        found = reader.read(image, given.views)
        right = is_read(found, code)
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


def is_read(found: PhotoReading, code: GaussCode) -> bool:
    """Return whether one closed rope was read, with this code, and no crossing of other ropes."""
    closed = [k for k, one in enumerate(found.ropes) if one.closed]
    if found.code is None or len(closed) != 1 or found.crossings != code.nx:
        return False
    own = RopesCode.of(found.code.rope(closed[0]))
    return own.smallest() == RopesCode.of(code).smallest()


def share(rows: list[dict[str, Any]]) -> float:
    return 100 * sum(row["right"] for row in rows) / max(1, len(rows))


def train(given: argparse.Namespace) -> None:
    """Train a network on photos drawn meanwhile, write its weights, and go on from these."""
    states = [read_states(shipped(name), images=False) for name in given.states]
    # more often with many crossings: `example` draws two and takes the later one
    codes = sorted(
        (nx, k, row) for k, one in enumerate(states) for row, nx in enumerate(one.nx.tolist())
        if one.split[row] == "train" and not held_out(label(one.points[row]))
    )  # fmt: skip
    ropes = [states[k].points[row] for _, k, row in codes]
    network, begun = StrandNetwork(), given.out / "training.pt"
    start = load_rope_reader(given.start).network.state_dict() if given.start else {}
    network.load_state_dict(
        {
            name: one[: len(network.state_dict()[name])] if one.dim() else one
            for name, one in start.items()
        },
        strict=bool(start),
    )
    mean = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(0.99))
    optimizer = torch.optim.AdamW(network.parameters(), lr=given.rate, weight_decay=1e-4)
    step, spent, parts = 0, 0.0, {"network": network, "mean": mean, "optimizer": optimizer}
    if begun.exists():
        kept = torch.load(begun)
        step, spent = kept["step"], kept["spent"]
        for name, part in parts.items():
            part.load_state_dict(kept[name])
    given.out.mkdir(parents=True, exist_ok=True)
    # statistics of few pictures are noise: those of weights that exist are kept
    network.train(not start).to(memory_format=torch.channels_last)
    last = time.process_time()
    while (done := spent / (60 * given.minutes)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = (
                given.rate * min(1, (step + 1) / 20) * (0.05 + 0.95 * math.cos(1.57 * done))
            )
        first = (given.seed * 10**6 + step) * given.batch
        drawn = zip(
            *(example(ropes, first + k, given.new) for k in range(given.batch)), strict=True
        )
        image, *true = (torch.from_numpy(np.stack(part)).to(given.device).float() for part in drawn)
        pictures, total = image.permute(0, 3, 1, 2), 0.0
        optimizer.zero_grad()
        for few in torch.arange(given.batch).split(PARTS):  # fewer at once fit into the caches
            # twice as many steps a second on processors with AMX; sums and weights stay float32
            with torch.autocast(given.device, torch.bfloat16, enabled=given.bfloat16):
                loss = strand_loss(network, pictures[few], *(one[few] for one in true))
            loss = loss * (len(few) / given.batch)
            loss.backward()
            total += loss.item()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        mean.update_parameters(network)
        step += 1
        now = time.process_time()
        spent, last = spent + now - last, now
        if step % given.every == 0 or spent > 60 * given.minutes:
            print(f"{spent:6.0f} CPU s  step {step}  loss {total:.3f}", flush=True)
            kept = {name: part.state_dict() for name, part in parts.items()}
            torch.save({**kept, "step": step, "spent": spent}, given.out / "new.pt")
            (given.out / "new.pt").replace(begun)
            save_rope_reader(copy.deepcopy(mean.module), given.out, {"steps": step})


def held_out(code: GaussCode) -> bool:
    """Return whether a diagram is kept for tests of what was never trained on."""
    return code.nx > 2 and crc32(str(canonical(code, Symmetry.DIAGRAM)).encode()) % 5 == 0


def example(ropes: list[Array], number: int, new: float) -> Example:
    """Draw a photo of a random rope, with heights switched in every other one.

    A share `new` has look phone; a third of these are drawn until they have a flat crossing, some
    are cut to another shape, with the colour of their border around them, as the reader puts
    pictures into a square, and some are enlarged, as it looks at thin ropes.
    """
    rng = np.random.default_rng(number)
    phone, several, flat = rng.random() < new, rng.random() < 0.35, rng.random() < 0.33
    config = AppearanceConfig(
        look="phone" if phone else "table", ropes=(2, 3, 4) if several else (1,), open=0.6,
        cropped=0.45,
    )  # fmt: skip
    tries = 4 if phone and flat else 1
    while True:
        rope = ropes[rng.integers(len(ropes), size=2).max()] * (1.0, 1.0, rng.choice((-1.0, 1.0)))
        shot = photograph(rope, SIDE, rng, config=config)
        if shot is None or shot.code.nx > MOST or (not shot.code.nx and rng.random() < 0.7):
            continue
        whole = shot.line.astype(np.float64)
        whole[:, 2] *= shot.look.scale
        lines = shot.ropes or [whole]
        met = find_ropes_crossings([one * (1.0, -1.0, 1.0) for one in lines], not shot.ropes)
        points, crossings, sines = np.concatenate(lines), np.zeros((MOST, 5)), [1.0]
        for k in range(len(met.sign)):
            over, under = (
                points[(place + 1) % len(points)] - points[place]
                for place in (int(met.over_place[k]), int(met.under_place[k]))
            )
            twice = 2 * np.arctan2(over[1], over[0])
            crossings[k] = *(met.position[k] * (1, -1)), np.cos(twice), np.sin(twice), 1
            cross = over[0] * under[1] - over[1] * under[0]
            sines.append(abs(cross) / np.hypot(*over[:2]) / np.hypot(*under[:2]))
        tries -= 1
        if tries <= 0 or min(sines) < 0.5:
            break
    drawn = [(one[:, :2], not shot.ropes) for one in lines] + [(one, False) for one in shot.others]
    image, line = shot.image, evenly(drawn)
    if not phone or (cut := rng.random()) > 0.5:
        return image, line, crossings
    low, high, places = np.zeros(2), np.full(2, SIDE), (line, crossings)
    if cut < 0.2:
        bare = cut < 0.05
        part = SIDE / rng.uniform(1.2, 2.7 if bare else 2.0)
        corners = np.floor(rng.uniform(0, SIDE - part, (40 if bare else 1, 2)))
        beads = line[:, None, :2]
        inside = (corners - CLEAR < beads) & (beads < corners + part + CLEAR)
        seen = inside.all(axis=2).any(axis=0)
        low = corners[seen.argmin()]  # the first without a rope, if there is one
        zoom = np.array([[SIDE / part, 0.0, 0.0], [0.0, SIDE / part, 0.0]])
        zoom[:, 2] = zoom[0, 0] * (0.5 - low) - 0.5
        image = cv2.warpAffine(image, zoom, (SIDE, SIDE))
        for found in places:
            found[:, :2] = (found[:, :2] - low) * zoom[0, 0]
        low = np.zeros(2)
    else:
        axis, share = rng.integers(2), rng.uniform(0.55, 1.0)
        low[axis] = rng.uniform(0, 1 - share) * SIDE
        high[axis] = low[axis] + share * SIDE
        at = np.arange(SIDE) + 0.5
        x, y = ((low[k] <= at) & (at < high[k]) for k in range(2))
        shown = (y[:, None] & x).view(np.uint8)
        edge = (shown > 0) & (cv2.erode(shown, np.ones((3, 3)), borderValue=0) == 0)
        image = np.where(shown[..., None], image, np.median(image[edge], axis=0).astype(np.uint8))
    for found in places:
        found[:, -1] *= np.all((low <= found[:, :2]) & (found[:, :2] < high), axis=1)
    return image, line, crossings


def evenly(lines: list[tuple[Array, bool]]) -> Array:
    """Return PLACES places (x, y, joined to the next), evenly along lines (n, 2), closed or not."""
    paths = [np.concatenate([one, one[:1]]) if closed else one for one, closed in lines]
    lengths = [np.hypot(*np.diff(one, axis=0).T) for one in paths]
    stops = np.rint(
        np.cumsum([0, *(one.sum() for one in lengths)]) / sum(map(sum, lengths)) * PLACES
    )
    found = []
    for (_, closed), path, steps, count in zip(
        lines, paths, lengths, np.diff(stops).astype(int), strict=True
    ):
        at = np.linspace(0, steps.sum(), count, endpoint=not closed)
        walked = np.append(0.0, np.cumsum(steps))
        own = np.stack([np.interp(at, walked, path[:, k]) for k in range(2)], axis=1)
        found.append(np.column_stack([own, np.arange(count) < count - (not closed)]))
    return np.concatenate(found)


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
    two = commands.add_parser("train", help="train on new photos of a table's ropes, or go on")
    two.set_defaults(run=train)
    two.add_argument("--states", nargs="+", default=["bench", "readable", "random-walk"])
    two.add_argument("--out", type=Path, required=True)
    two.add_argument("--minutes", type=float, default=60, help="CPU minutes")
    two.add_argument("--batch", type=int, default=16)
    two.add_argument("--start", help="folder of a reader to begin from, or rope-reader")
    two.add_argument("--rate", type=float, default=2e-3, help="highest learning rate")
    two.add_argument("--new", type=float, default=0.75, help="share of photos of look phone")
    two.add_argument("--every", type=int, default=20, help="steps between checkpoints")
    two.add_argument("--device", default="cpu")
    two.add_argument("--bfloat16", action="store_true", help="compute in this precision")
    two.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
