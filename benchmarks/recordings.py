"""Make the recordings that ship with the suite.

    knotgym suite --policy noisy,expert,play --split train --states readable --resume --out FOLDER
    python benchmarks/recordings.py FOLDER

Records every demonstrator's dataset of the suite in the folder, and keeps what --out has of others;
the same datasets give the same bytes.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from rich.console import Console

from knotgym.datasets import open_episodes
from knotgym.generate import Recording, SuiteConfig

RECORDINGS = Path(__file__).parents[1] / "knotgym/generate/data/recordings.h5"


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="--out of knotgym suite")
    parser.add_argument("--out", type=Path, default=RECORDINGS)
    args = parser.parse_args()
    kept = dict(Recording.read_all(args.out)) if args.out.exists() else {}
    for config in SuiteConfig(policies=("noisy", "expert", "play")).sets():
        made = args.folder / config.dataset_id
        if made.exists():
            kept[config.dataset_id] = Recording.of(config, open_episodes(made).episodes)
    Recording.write_all(args.out, [*kept.values()])
    size = args.out.stat().st_size
    Console().print(f"{args.out.name}: {len(kept)} datasets, {size:,} bytes")


if __name__ == "__main__":
    main()
