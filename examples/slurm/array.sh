#!/bin/bash
# Run one shard of a knotgym command, chosen by the array task's number, which counts from 1:
#   sbatch --array=1-32 array.sh 32 generate --nx 4 --count 3200 --out runs/nx4
# The first argument is the number of shards. It stays the same when single tasks are submitted again:
#   sbatch --array=7 array.sh 32 generate --nx 4 --count 3200 --out runs/nx4
#SBATCH --cpus-per-task=4
#SBATCH --time=04:00:00
#SBATCH --requeue
set -euo pipefail
count=${1:-}
if ! [[ $count =~ ^[1-9][0-9]*$ ]]; then
    echo "array.sh: the first argument is the number of shards, as in: sbatch --array=1-32 array.sh 32 generate ..." >&2
    exit 2
fi
shift
if ((SLURM_ARRAY_TASK_MIN < 1 || SLURM_ARRAY_TASK_MAX > count)); then
    echo "array.sh: tasks are numbered from 1 to $count, got $SLURM_ARRAY_TASK_MIN to $SLURM_ARRAY_TASK_MAX: submit with --array=1-$count" >&2
    exit 2
fi
exec knotgym "$@" --set "run.shard=$SLURM_ARRAY_TASK_ID/$count" --workers "$SLURM_CPUS_PER_TASK" --resume --quiet
