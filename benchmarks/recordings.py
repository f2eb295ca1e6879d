"""Make the recordings that ship with the suite, and the figures that its card says of them.

    knotgym suite --policies noisy,expert --split train --states readable --resume --out FOLDER
    python benchmarks/recordings.py FOLDER
    OMP_NUM_THREADS=1 python benchmarks/recordings.py FOLDER --measure --nx 2
    python benchmarks/recordings.py FOLDER --scores LEARNER/evaluation.json...

The second records every demonstrator's dataset of the suite in the folder, and keeps what --out has
of others; the same datasets give the same bytes. `--measure` trains a clone on each dataset in the
folder, which needs torch and takes a minute of a core or more, and writes how often it guesses the
bead of a held-out macro-action. `--scores` writes which learner of the evaluations was the best of
those trained on each. Figures that aren't measured again are kept while they fit the recording.
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
from knotgym.generate.episodes.suite_scores import best_learner, read_scores

POLICIES = ("noisy", "expert", "play")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="--out of knotgym suite")
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--scores", type=Path, nargs="+", default=[], help="of learners")
    parser.add_argument("--task", nargs="+", default=["tie", "convert", "unknot"])
    parser.add_argument("--nx", type=int, nargs="+", default=[2, 3, 4], help="to measure")
    parser.add_argument("--out", type=Path, default=RECORDINGS)
    args = parser.parse_args()
    console, figures = Console(), args.out.with_suffix(".json")
    if not args.measure and not args.scores:
        sets = SuiteConfig(policies=POLICIES).sets()
        there = [args.folder / one.dataset_id for one in sets]
        made = {one.name: one for one in map(record, filter(Path.exists, there))}
        kept = [
            one for one in (recorded_ids(args.out) if args.out.exists() else []) if one not in made
        ]
        write_recordings(
            args.out, [*made.values(), *(read_recording(one, args.out) for one in kept)]
        )
        size = args.out.stat().st_size
        console.print(f"{args.out.name}: {len(recorded_ids(args.out))} datasets, {size:,} bytes")
        return
    told = json.loads(figures.read_text(encoding="utf-8")) if figures.is_file() else {}
    digests = {name: read_recording(name, args.out).digest for name in recorded_ids(args.out)}
    told = {name: one for name, one in told.items() if one["recording_sha256"] == digests.get(name)}
    for name, digest in digests.items():
        told.setdefault(name, {"recording_sha256": digest})
    scores = read_scores(args.scores)
    config = SuiteConfig(policies=POLICIES, tasks=tuple(args.task), nx=tuple(args.nx))
    for name in [one.dataset_id for one in config.sets() if one.dataset_id in digests]:
        if args.measure and (args.folder / name).exists():
            from knotgym.learn.clone_training import predictability  # recording needs no torch

            found = predictability([args.folder / name])
            told[name]["predictability"] = {
                "bead_top1": round(found.bead_top1, 4),
                "r2": [round(share, 2) for share in found.r2],
                "decisions": found.decisions,
            }
            console.print(f"{name}: {found}")
        if best := best_learner(name, scores):
            told[name]["learner"] = best
        with atomic_write(figures) as temporary:
            temporary.write_text(json.dumps(told, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    main()
