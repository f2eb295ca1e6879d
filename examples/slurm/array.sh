#!/bin/bash
# Run one shard of a knotgym command, chosen by the array task's number:
#   sbatch --array=1-32 array.sh generate --nx 4 --count 3200 --out runs/nx4
#SBATCH --cpus-per-task=4
#SBATCH --time=04:00:00
#SBATCH --requeue
set -euo pipefail
exec knotgym "$@" --set "run.shard=$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" --workers "$SLURM_CPUS_PER_TASK" --resume --quiet
