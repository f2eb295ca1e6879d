"""How fast a perception table is read: pictures per second through torch's DataLoader.

    python benchmarks/images.py FOLDER [--workers 2] [--batch 64]

FOLDER is a table that `knotgym images` wrote. Needs the extras torch and huggingface.
"""

import argparse
import time

from torch.utils.data import DataLoader

from knotgym.loaders import images


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--epochs", type=int, default=3)
    given = parser.parse_args()
    began = time.perf_counter()
    dataset = images(given.folder)
    print(f"opened {len(dataset)} pictures in {time.perf_counter() - began:.2f} s")
    loader = DataLoader(
        dataset,
        given.batch,
        shuffle=True,
        num_workers=given.workers,
        persistent_workers=given.workers > 0,
    )
    for epoch in range(given.epochs):
        began = time.perf_counter()
        seen = sum(len(batch["image"]) for batch in loader)
        seconds = time.perf_counter() - began
        print(
            f"epoch {epoch}: {seen / seconds:.0f} pictures a second, {given.workers} workers,"
            f" batches of {given.batch}"
        )


if __name__ == "__main__":
    main()
