"""Read real photographs whose codes were counted by eye, and print what was right.

    python benchmarks/real_photos.py FOLDER LABELS

FOLDER has the repositories that LABELS names, as OWNER/NAME or, with one repository, its files.
LABELS is a CSV file with the columns repo, path, ropes, ends (open or closed), crossings and
gauss_code. docs/photos.md has the table.
"""

import csv
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

from knotgym.learn import read_photo
from knotgym.topology import RopesCode


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("labels", type=Path)
    args = parser.parse_args()
    counts = dict.fromkeys(
        ("crossings", "whole code", "false closed", "no rope", "sure", "sure and right"), 0
    )
    with args.labels.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    began = time.process_time()
    for row in rows:
        path = args.folder / row["repo"] / row["path"]
        reading = read_photo(path if path.exists() else args.folder / row["path"])
        closed = row["ends"] == "closed"
        wanted = RopesCode.parse(row["gauss_code"], closed).smallest()
        right = reading.code is not None and reading.code.plain.smallest() == wanted
        counts["crossings"] += reading.crossings == int(row["crossings"])
        counts["whole code"] += right
        counts["false closed"] += reading.closed and not closed
        counts["no rope"] += not reading.ropes
        counts["sure"] += reading.confidence >= 0.5
        counts["sure and right"] += right and reading.confidence >= 0.5
        if not right:
            shown = reading.code and reading.code.plain.smallest()
            print(
                f"{row['path']}: {wanted}, read {shown} ({reading.confidence:.2f}) {reading.reason}"
            )
    for name, count in counts.items():
        print(f"{count:6} of {len(rows)}  {name}")
    print(f"{(time.process_time() - began) / max(len(rows), 1):.2f} CPU seconds each")


if __name__ == "__main__":
    main()
