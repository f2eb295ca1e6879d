"""Make the recordings that ship with the suite, and the figures that its card says of them.

    knotgym suite --policies noisy,expert --split train --states readable --resume --out FOLDER
    python benchmarks/recordings.py FOLDER
    OMP_NUM_THREADS=1 python benchmarks/recordings.py FOLDER --measure --nx 2

The second records every demonstrator's dataset of the suite in the folder; the same datasets give
the same bytes. `--measure` trains a clone on each of them, which needs torch and takes minutes of a
core, and writes how often it guesses the bead of a held-out macro-action. Figures of datasets that
aren't measured again are kept while they fit the recording.
"""

import argparse
import json
from pathlib import Path

from rich.console import Console

from knotgym.common.atomic_files import atomic_write
from knotgym.generate.episodes.recordings import (
    RECORDINGS,
    read_recording,
    record,
    recorded_ids,
    write_recordings,
)
from knotgym.generate.episodes.suite import SuiteConfig

POLICIES = ("noisy", "expert", "play")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="--out of knotgym suite")
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--task", nargs="+", default=["tie", "convert", "unknot"])
    parser.add_argument("--nx", type=int, nargs="+", default=[2, 3, 4], help="to measure")
    parser.add_argument("--out", type=Path, default=RECORDINGS)
    args = parser.parse_args()
    console, figures = Console(), args.out.with_suffix(".json")
    if not args.measure:
        sets = SuiteConfig(policies=POLICIES).sets()
        there = [args.folder / one.dataset_id for one in sets]
        write_recordings(args.out, [record(made) for made in there if made.exists()])
        size = args.out.stat().st_size
        console.print(f"{args.out.name}: {len(recorded_ids(args.out))} datasets, {size:,} bytes")
        return
    from knotgym.learn.clone_training import predictability  # recording needs no torch

    told = json.loads(figures.read_text(encoding="utf-8")) if figures.is_file() else {}
    digests = {name: read_recording(name, args.out).digest for name in recorded_ids(args.out)}
    told = {name: one for name, one in told.items() if one["recording_sha256"] == digests.get(name)}
    config = SuiteConfig(policies=POLICIES, tasks=tuple(args.task), nx=tuple(args.nx))
    for name in [one.dataset_id for one in config.sets() if one.dataset_id in digests]:
        share, decisions = predictability([args.folder / name])
        told[name] = {
            "bead_top1": round(share, 4),
            "decisions": decisions,
            "recording_sha256": digests[name],
        }
        console.print(f"{name}: bead top-1 {100 * share:.1f} % of {decisions} held out")
        with atomic_write(figures) as temporary:
            temporary.write_text(json.dumps(told, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    main()
