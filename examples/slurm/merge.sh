#!/bin/bash
# Merge all shards of a run once they are finished:
#   sbatch --dependency=afterok:ARRAY merge.sh runs/nx4
# For a collection, give the dataset and then the root of its id:
#   sbatch --dependency=afterok:ARRAY merge.sh data/knotgym/tie-nx3/expert-v0 data
#SBATCH --time=01:00:00
set -euo pipefail
knotgym dataset merge "$1"-shard-*-of-* --out "${2:-$1}"
knotgym dataset verify "$1" --quiet
