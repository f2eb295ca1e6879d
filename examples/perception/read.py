"""Learn to read Gauss codes: a small convolutional network, one picture in, the code out.

    python examples/perception/read.py FOLDER [--minutes 30] [--out reader]

The network looks at every 2 x 2 pixels of a published picture and says whether a crossing lies there, where exactly, and where along
the rope its two strands are (the hue says so); the code is the crossings found, sorted by their places. So it learns from the
crossings of the table, and can read codes that it has never seen and more crossings than it was trained on. It is trained on crops,
every other one at a crossing: all that a crossing needs and a fifth of the work. Writes `reader.pt`, `report.json` with the
exact-match accuracy by nx, by grade and by split, and a page of misread pictures, `confusions.png`. Needs the extras torch and
huggingface.
"""

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from knotgym.datasets.images import GRADES
from knotgym.gauss import GaussCode
from knotgym.loaders import images

BEADS = 100
CELL = 2  # pixels of a side
CROP = 32  # pixels of a side
SPLITS = ("test", "test-code", "test-nx")


class Reader(nn.Module):
    """Pictures uint8 (n, 3, size, size) to float32 (n, 7, size / 2, size / 2): logit, offset x and y in cells, over and under as vectors."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(3, width, 5, stride=CELL, padding=2)]
        for dilation in (1, 2, 1, 2):
            layers += [nn.BatchNorm2d(width), nn.ReLU(), nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)]
        self.body = nn.Sequential(*layers, nn.BatchNorm2d(width), nn.ReLU(), nn.Conv2d(width, 2 * width, 1), nn.ReLU(), nn.Conv2d(2 * width, 7, 1))

    def forward(self, pictures: Tensor) -> Tensor:
        return self.body(pictures.float() / 255)


def targets(batch: dict[str, Tensor], cells: int) -> tuple[Tensor, Tensor]:
    """Whether each cell has a crossing, float32 (n, cells, cells), and its 6 numbers (n, 6, cells, cells)."""
    n = len(batch["nx"])
    there, numbers = torch.zeros(n, cells, cells), torch.zeros(n, 6, cells, cells)
    rows, order = torch.nonzero(torch.arange(batch["crossings"].shape[1]) < batch["nx"][:, None], as_tuple=True)
    x, y, over, under = batch["crossings"][rows, order].T
    column, row = (x / CELL).long().clamp(0, cells - 1), (y / CELL).long().clamp(0, cells - 1)
    there[rows, row, column] = 1
    turn = [2 * np.pi * place / BEADS for place in (over, under)]
    values = [x / CELL - column - 0.5, y / CELL - row - 0.5, *(wave(angle) for angle in turn for wave in (torch.cos, torch.sin))]
    numbers[rows, :, row, column] = torch.stack(values, dim=1).float()
    return there, numbers


def loss(out: Tensor, there: Tensor, numbers: Tensor) -> Tensor:
    """Focal loss of where crossings are, neighbours of one forgiven a little, and squared error of the numbers where they are."""
    near = functional.max_pool2d(there[:, None], 3, 1, 1)[:, 0] * (1 - there)
    chance = torch.sigmoid(out[:, 0])
    found = -(there * (1 - chance) ** 2 * functional.logsigmoid(out[:, 0]))
    false = -((1 - there) * (1 - 0.7 * near) * chance**2 * functional.logsigmoid(-out[:, 0]))
    count = there.sum().clamp(min=1)
    error = ((out[:, 1:] - numbers) ** 2 * there[:, None]).sum(dim=(0, 2, 3)) / count
    return (found.sum() + false.sum()) / count + error[:2].sum() + 10 * error[2:].sum()


def decode(out: Tensor) -> list[GaussCode]:
    """The codes that the network's numbers (n, 7, cells, cells) spell: peaks above one half, two cells apart."""
    chance = torch.sigmoid(out[:, :1])
    peak = (chance == functional.max_pool2d(chance, 3, 1, 1)) & (chance > 0.5)
    codes = []
    for picture, numbers in zip(peak[:, 0], out.detach(), strict=True):
        at = numbers[:, picture].T.numpy()
        over, under = (np.arctan2(at[:, k + 1], at[:, k]) / (2 * np.pi) % 1.0 for k in (3, 5))
        visits = sorted([(place, label) for label, place in enumerate(over, 1)] + [(place, -label) for label, place in enumerate(under, 1)])
        codes.append(GaussCode.relabelled([label for _, label in visits]))
    return codes


def turned(batch: dict[str, Tensor], rng: np.random.Generator) -> dict[str, Tensor]:
    """A batch turned by a quarter and reflected at random: places along the rope and over and under stay."""
    image, crossings = batch["image"], batch["crossings"].clone()
    size = image.shape[-1]
    if rng.random() < 0.5:
        image, crossings[..., 0] = image.flip(-1), size - crossings[..., 0]
    if rng.random() < 0.5:
        image, crossings[..., 1] = image.flip(-2), size - crossings[..., 1]
    if rng.random() < 0.5:
        image, crossings = image.transpose(-1, -2), crossings[..., [1, 0, 2, 3]]
    return {**batch, "image": image.contiguous(), "crossings": crossings}


def cropped(batch: dict[str, Tensor], crops: int, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Crops of CROP pixels of every picture, every other one at a crossing, the rest at any pixel of the rope; with their targets."""
    there, numbers = targets(batch, batch["image"].shape[-1] // CELL)
    pictures, cells = batch["image"], CROP // CELL
    most = there.shape[-1] - cells
    cut: list[tuple[Tensor, Tensor, Tensor]] = []
    for k, nx in enumerate(batch["nx"].tolist()):
        drawn = torch.nonzero(pictures[k].amax(dim=0) > 60)
        for crop in range(crops):
            if nx and crop % 2 == 0:
                column, row = batch["crossings"][k, rng.integers(nx), :2].tolist()
            else:
                row, column = drawn[rng.integers(len(drawn))].tolist()
            top, left = (int(np.clip(at / CELL - rng.uniform(0.2, 0.8) * cells, 0, most)) for at in (row, column))
            rows, columns = slice(top, top + cells), slice(left, left + cells)
            seen = pictures[k, :, CELL * top : CELL * top + CROP, CELL * left : CELL * left + CROP]
            cut.append((seen, there[k, rows, columns], numbers[k, :, rows, columns]))
    return torch.stack([one[0] for one in cut]), torch.stack([one[1] for one in cut]), torch.stack([one[2] for one in cut])


def train(folder: str, minutes: float, seed: int, batch_size: int) -> Reader:
    """Train for so many minutes, the learning rate falling to nothing by then."""
    torch.manual_seed(seed)
    rng, data, net = np.random.default_rng(seed), images(folder, "train"), Reader()
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3, weight_decay=1e-4)
    pictures = torch.stack([torch.from_numpy(data.picture(row)) for row in range(len(data))])
    began, told, step = time.perf_counter(), 0.0, 0
    while (spent := time.perf_counter() - began) < 60 * minutes:
        rows = torch.from_numpy(rng.choice(len(data), min(batch_size, len(data)), replace=False))
        batch = turned({"image": pictures[rows], **{name: column[rows] for name, column in data.labels.items()}}, rng)
        optimizer.param_groups[0]["lr"] = 3e-3 * min(1.0, (step + 1) / 100) * (0.5 + 0.5 * np.cos(np.pi * spent / (60 * minutes)))
        seen, there, numbers = cropped(batch, 3, rng)
        value = loss(net(seen), there, numbers)
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimizer.step()
        step += 1
        if spent - told > 30:
            told = spent
            print(f"{spent:5.0f} s  step {step}  {step * batch_size / len(data):.1f} epochs  loss {value.item():.3f}", flush=True)
    return net.eval()


@torch.no_grad()
def evaluate(net: Reader, folder: str) -> tuple[dict[str, str], list[tuple[np.ndarray, str, str]]]:
    """Exact matches, "right of all", by split, nx and grade; and the misread pictures that were accepted."""
    score: dict[str, list[bool]] = defaultdict(list)
    missed = []
    for split in SPLITS:
        try:
            data = images(folder, split)
        except ValueError:  # the table has no such split
            continue
        for row, code in enumerate(data.codes):
            picture = data.picture(row)
            read = str(decode(net(torch.from_numpy(picture)[None]))[0])
            nx, accepted = int(data.labels["nx"][row]), bool(data.labels["accepted"][row])
            grade = GRADES[int(data.labels["grade"][row])]
            for key in ("", f", nx {nx}", f", {grade}", *([", accepted", f", accepted, nx {nx}"] if accepted else [])):
                score[split + key].append(read == code)
            if accepted and read != code:
                missed.append((np.moveaxis(picture, 0, -1), code, read))
    return {key: f"{100 * np.mean(hits):.1f} % of {len(hits)}" for key, hits in sorted(score.items())}, missed


def page(missed: list[tuple[np.ndarray, str, str]], path: Path, columns: int = 5, side: int = 256) -> None:
    """Draw misread pictures with the code they show (white) and the code read (red)."""
    tiles = []
    for picture, code, read in missed[: 8 * columns]:
        tile = np.zeros((side + 40, side, 3), dtype=np.uint8)
        tile[:side] = cv2.resize(picture, (side, side), interpolation=cv2.INTER_NEAREST)
        for line, (text, colour) in enumerate(((code, (255, 255, 255)), (read, (255, 90, 90)))):
            cv2.putText(tile, text or "loop", (2, side + 14 + 18 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA)
        tiles.append(tile)
    if tiles:
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
        rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
        cv2.imwrite(str(path), np.concatenate(rows)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("reader"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    net = train(given.folder, given.minutes, given.seed, given.batch)
    torch.save(net.state_dict(), given.out / "reader.pt")
    score, missed = evaluate(net, given.folder)
    (given.out / "report.json").write_text(json.dumps({"minutes": given.minutes, "seed": given.seed, "exact match": score}, indent=1))
    page(missed, given.out / "confusions.png")
    for key, value in score.items():
        print(f"{key:28} {value}")


if __name__ == "__main__":
    main()
