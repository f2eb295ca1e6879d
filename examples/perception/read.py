"""Train a small convolutional network to read the Gauss code of a picture.

    python examples/perception/read.py FOLDER [--steps 20000] [--out reader]

For every cell of 2 x 2 pixels, the network predicts whether there is a crossing, and which pixels
around it show the colours of the over and the under strand. In published pictures the hue encodes
the position along the rope, so these two colours give two positions, and the code is the crossings
sorted by position. Because the targets are single crossings, the network can read codes that it has
never seen, with more crossings than it was trained on.

It is trained on crops, half of them at a crossing, augmented by reflections, quarter turns and
shifts of the colours along the rope, all of which are exact. Writes `reader.pt`, `report.json` with
exact matches, crossing counts and edit distances by split, nx and grade, and a page of misread
pictures, `confusions.png`. Needs the extras torch and huggingface.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("read.py needs torch: pip install '.[torch,huggingface]'") from error
from pictures import Misread, page
from torch import Tensor, nn
from torch.nn import functional

from knotgym.loaders import images
from knotgym.prompting import reading_scores, reading_table
from knotgym.quality import GRADES
from knotgym.topology import GaussCode

BEADS = 100
CELL = 2  # width of a cell, pixels
CROP = 32  # width of a crop, pixels
EDGE = 2  # cells at the border of a crop that have no loss, because the rope is cut off there
WINDOW = 10  # width of the window around a cell in which its strands' colours are sought, pixels
# Sharpness of colour similarity: exp(60 (cos(angle) - 1)) is 1/3 at a difference of 3 beads.
SHARP = 60.0
SPLITS = ("test", "test-code", "test-nx")

# Published colours are RGB = BASIS (grey, sine, cosine), with the sine and cosine of the hue; black
# and white only change grey.
_TURN = 2 * torch.pi * torch.tensor([0.0, 0.33, 0.67])
BASIS = torch.stack([torch.ones(3), torch.cos(_TURN), torch.sin(_TURN)], dim=1)


class Reader(nn.Module):
    """A network that finds crossings and the positions of their strands along the rope."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(3, width, 5, stride=CELL, padding=2)]
        for dilation in (1, 2, 1, 2):
            layers += [
                nn.BatchNorm2d(width),
                nn.ReLU(),
                nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation),
            ]
        self.body = nn.Sequential(
            *layers, nn.BatchNorm2d(width), nn.ReLU(), nn.Conv2d(width, 2 * width, 1), nn.ReLU()
        )
        self.there = nn.Conv2d(2 * width, 1, 1)
        nn.init.constant_(self.there.bias, -4.0)  # crossings are rare
        self.look = nn.Linear(2 * width, 2 * WINDOW**2)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logits of crossings, float32 (n, cells, cells), and the features of all cells.

        `pictures` are float32 (n, 3, size, size) in [0, 1].
        """
        features = self.body(pictures)
        return self.there(features)[:, 0], features

    def strands(
        self, pictures: Tensor, features: Tensor, cells: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Attend to the pixels that show the strands of k crossings.

        Args:
            pictures: float32 (n, 3, size, size) in [0, 1].
            features: of all cells, from `forward`.
            cells: picture, row and column of each crossing, int64 (k,) each.

        Returns:
            Attention of the over and the under strand, float32 (k, 2, WINDOW ** 2), and the pixels'
            hue vectors (sine, cosine), float32 (k, WINDOW ** 2, 2), whose length is a pixel's
            brightness. Their weighted mean is the strand's hue. Pixels of the over strand's colour
            get no weight for the under strand.
        """
        picture, row, column = cells
        look = self.look(features[picture, :, row, column]).reshape(len(row), 2, WINDOW**2)
        margin = (WINDOW - CELL) // 2
        padded = functional.pad(pictures, (margin, margin, margin, margin))
        across = torch.arange(WINDOW)
        rows, columns = (
            (CELL * row[:, None] + across)[:, :, None],
            (CELL * column[:, None] + across)[:, None],
        )
        seen = padded[picture[:, None, None], :, rows, columns].flatten(1, 2)
        seen = 2 * seen @ torch.linalg.inv(BASIS).T[:, 1:]
        bright = seen.norm(dim=2)
        over = (look[:, 0] + torch.log(bright + 1e-3)).softmax(dim=1)
        other = 1 - alike((over.detach()[:, None] @ seen), seen)[:, 0]
        under = (look[:, 1] + torch.log(bright * other + 1e-3)).softmax(dim=1)
        return torch.stack([over, under], dim=1), seen


def alike(waves: Tensor, others: Tensor) -> Tensor:
    """Return the similarity of the hues of (k, n, 2) and (k, m, 2), (k, n, m): 1 for equal hues."""
    return torch.exp(
        SHARP
        * (
            functional.normalize(waves, dim=2) @ functional.normalize(others, dim=2).transpose(1, 2)
            - 1
        )
    )


def hue_vectors(along: Tensor) -> Tensor:
    """Map positions along the rope, beads, (...) to unit hue vectors (sine, cosine), (..., 2)."""
    angle = 2 * torch.pi * along / BEADS
    return torch.stack([torch.sin(angle), torch.cos(angle)], dim=-1)


def read(net: Reader, pictures: Tensor) -> list[GaussCode]:
    """Read the codes of pictures, uint8 (n, 3, size, size).

    Crossings are cells of probability above 1/2 that exceeds those of the eight cells around.
    """
    pictures = pictures.float() / 255
    logit, features = net(pictures)
    cells = torch.nonzero(
        (logit == functional.max_pool2d(logit, 3, 1, 1)) & (logit > 0), as_tuple=True
    )
    weight, seen = net.strands(pictures, features, cells)
    wave = weight @ seen
    positions = (torch.atan2(wave[..., 0], wave[..., 1]) / (2 * torch.pi) % 1.0).tolist()
    visits: list[list[tuple[float, int]]] = [[] for _ in pictures]
    for label, (picture, (over, under)) in enumerate(
        zip(cells[0].tolist(), positions, strict=True), 1
    ):
        visits[picture] += [(over, label), (under, -label)]
    return [GaussCode.relabelled([label for _, label in sorted(own)]) for own in visits]


class Crops:
    """Training crops: half of them at a crossing, the rest anywhere on the rope."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        data, self.rng = images(folder, "train"), rng
        self.pictures = torch.from_numpy(np.stack([data.picture(row) for row in range(len(data))]))
        self.nx, self.crossings = data.labels["nx"], data.labels["crossings"]
        self.picture, self.order = torch.nonzero(
            torch.arange(data.max_nx) < self.nx[:, None], as_tuple=True
        )
        bright = (np.argwhere(picture.amax(dim=0).numpy() > 60) for picture in self.pictures)
        # rows and columns
        self.rope = np.stack([own[rng.integers(len(own), size=100)] for own in bright]).astype(
            np.uint8
        )

    def draw(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw crops and their targets.

        Returns:
            Crops, float32 (count, 3, CROP, CROP) in [0, 1]; their crossings, float32 (k, 5): crop,
            x and y in pixels, positions of over and under strand in beads; and a map, float32
            (count, cells, cells), that is 1 at a crossing, 0.5 next to one and 0 elsewhere.
        """
        rng, size, half = self.rng, self.pictures.shape[-1], count // 2
        some = rng.integers(len(self.picture), size=half)
        pick = np.concatenate(
            [self.picture[some].numpy(), rng.integers(len(self.pictures), size=count - half)]
        )
        middle = np.empty((count, 2))
        middle[:half] = self.crossings[self.picture[some], self.order[some], :2].numpy()[:, ::-1]
        middle[half:] = self.rope[pick[half:], rng.integers(100, size=count - half)]
        corner = np.clip(
            middle - CROP * rng.uniform(0.25, 0.75, size=(count, 2)), 0, size - CROP
        ).astype(int)
        across = np.arange(CROP)
        rows, columns = (
            (corner[:, :1] + across)[:, None, :, None],
            (corner[:, 1:] + across)[:, None, None],
        )
        pieces = (
            self.pictures[
                pick[:, None, None, None], np.arange(3)[None, :, None, None], rows, columns
            ].float()
            / 255
        )
        crossings = self.crossings[pick].clone()
        crossings[..., :2] -= torch.from_numpy(corner[:, None, ::-1].copy())
        inside = (torch.arange(crossings.shape[1]) < self.nx[pick][:, None]) & (
            (crossings[..., :2] >= 0) & (crossings[..., :2] < CROP)
        ).all(dim=2)
        piece, order = torch.nonzero(inside, as_tuple=True)
        return self._augmented(pieces, torch.cat([piece[:, None], crossings[piece, order]], dim=1))

    def _augmented(self, pieces: Tensor, crossings: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Augment crops: reflect and turn all alike, shift the colours of each along the rope.

        None of this exchanges over and under.
        """
        if self.rng.random() < 0.5:
            pieces, crossings[:, 1] = pieces.flip(-1), CROP - crossings[:, 1]
        if self.rng.random() < 0.5:
            pieces, crossings[:, 2] = pieces.flip(-2), CROP - crossings[:, 2]
        if self.rng.random() < 0.5:
            pieces, crossings = pieces.transpose(-1, -2), crossings[:, [0, 2, 1, 3, 4]]
        shift = torch.from_numpy(self.rng.uniform(0, BEADS, size=len(pieces))).float()
        (sine, cosine), turns = hue_vectors(shift).T, torch.eye(3).expand(len(pieces), 3, 3).clone()
        turns[:, 1, 1], turns[:, 1, 2], turns[:, 2, 1], turns[:, 2, 2] = cosine, sine, -sine, cosine
        # a shift along the rope rotates (sine, cosine) and leaves grey alone
        pieces = torch.einsum("nij,njrc->nirc", BASIS @ turns @ torch.linalg.inv(BASIS), pieces)
        crossings[:, 3:] += shift[crossings[:, 0].long(), None]
        there = torch.zeros(len(pieces), CROP // CELL, CROP // CELL)
        column, row = ((crossings[:, k] / CELL).long().clamp(0, CROP // CELL - 1) for k in (1, 2))
        there[crossings[:, 0].long(), row, column] = 1
        return pieces, crossings, torch.maximum(there, 0.5 * functional.max_pool2d(there, 3, 1, 1))


def loss(net: Reader, pieces: Tensor, crossings: Tensor, there: Tensor) -> Tensor:
    """Return the loss per crossing, the sum of three terms.

    - binary cross entropy of the crossing map, with weight 0.1 for cells next to a crossing
    - negative log of the attention on pixels with about the strand's hue
    - squared error of the hue vectors that the attention gives
    """
    logit, features = net(pieces)
    inner = slice(EDGE, -EDGE)
    weight = torch.where(there == 0.5, 0.1, 1.0)
    located = functional.binary_cross_entropy_with_logits(
        logit, (there == 1).float(), weight, reduction="none"
    )[:, inner, inner].sum()
    last = CROP // CELL - EDGE
    column, row = ((crossings[:, k] / CELL).long() for k in (1, 2))
    kept = (column >= EDGE) & (column < last) & (row >= EDGE) & (row < last)
    weight, seen = net.strands(
        pieces, features, (crossings[kept, 0].long(), row[kept], column[kept])
    )
    # the segment from position 2 to 3 has the colour of bead 2, so its mean position is 2.5
    wave = hue_vectors(crossings[kept, 3:] - 0.5)
    pointed = -torch.log((weight * alike(wave, seen)).sum(dim=2) + 1e-3).sum()
    error = ((functional.normalize(weight @ seen, dim=2, eps=1e-3) - wave) ** 2).sum()
    return (located + pointed + 3 * error) / max(1, int(kept.sum()))


def train(folder: Path, steps: int, batch: int, seed: int) -> Reader:
    """Train for `steps` steps with warm-up and a cosine schedule down to 0."""
    torch.manual_seed(seed)
    net, crops = Reader(), Crops(folder, np.random.default_rng(seed))
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3, weight_decay=1e-4)
    began = reported = time.perf_counter()
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = (
            3e-3 * min(1.0, (step + 1) / 100) * (0.5 + 0.5 * np.cos(np.pi * step / steps))
        )
        value = loss(net, *crops.draw(batch))
        optimizer.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimizer.step()
        if time.perf_counter() - reported > 30:
            reported = time.perf_counter()
            print(
                f"{reported - began:5.0f} s  step {step + 1} of {steps}  loss {value.item():.3f}",
                flush=True,
            )
    return net.eval()


@torch.no_grad()
def evaluate(net: Reader, folder: Path) -> tuple[dict[str, Any], list[Misread]]:
    """Return scores by split, and the accepted pictures that were misread."""
    scores: dict[str, Any] = {}
    missed = []
    for split in SPLITS:
        try:
            data = images(folder, split)
        except ValueError:  # the table has no such split
            continue
        readings: list[dict[str, Any]] = []
        for first in range(0, len(data), 50):
            rows = range(first, min(first + 50, len(data)))
            pictures = np.stack([data.picture(row) for row in rows])
            for row, picture, read_code in zip(
                rows, pictures, read(net, torch.from_numpy(pictures)), strict=True
            ):
                code, accepted = data.codes[row], bool(data.labels["accepted"][row])
                grade = GRADES[int(data.labels["grade"][row])]
                found = None if read_code is None else str(read_code)
                readings.append(
                    {"gauss_code": code, "read": found, "grade": grade, "accepted": accepted}
                )
                exact = read_code is not None and read_code.matches(GaussCode.parse(code))
                if accepted and not exact:
                    missed.append((np.moveaxis(picture, 0, -1), code, str(read_code)))
        scores[split] = reading_scores(readings)
    return scores, missed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--batch", type=int, default=96, help="crops per step")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("reader"))
    given = parser.parse_args()
    look = json.loads((given.folder / "manifest.json").read_text())["config"]["appearance"]
    if look["name"] != "published" or "colours" in look["vary"] or len(look["sizes"] or ()) > 1:
        parser.error(
            "positions along the rope are read from the published colours, in pictures of one size;"
            " this table has other colours or sizes"
        )
    given.out.mkdir(parents=True, exist_ok=True)
    net = train(given.folder, given.steps, given.batch, given.seed)
    torch.save(net.state_dict(), given.out / "reader.pt")
    scores, missed = evaluate(net, given.folder)
    report = {"steps": given.steps, "batch": given.batch, "seed": given.seed, "scores": scores}
    (given.out / "report.json").write_text(json.dumps(report, indent=1))
    if missed:
        page(missed, given.out / "confusions.png")
    else:
        print("nothing was misread, so there is no confusions.png")
    for split, score in scores.items():
        print(split)
        for row in reading_table(score):
            print("{:16} {:>6} {:>8} {:>9} {:>6}".format(*row))


if __name__ == "__main__":
    main()
