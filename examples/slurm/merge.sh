#!/bin/bash
# Merge all shards of a run once they are finished: the same command, without a shard.
#   sbatch --dependency=afterok:$array merge.sh generate --nx 4 --count 3200 --out runs/nx4
#SBATCH --cpus-per-task=4
#SBATCH --time=04:00:00
set -euo pipefail
exec knotgym "$@" --workers "$SLURM_CPUS_PER_TASK" --resume --quiet
