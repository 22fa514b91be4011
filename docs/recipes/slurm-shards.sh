#!/bin/bash
# A job array of shards, each with a writer of its own, merged by a second job:
#   job=$(sbatch --parsable --array=0-999 docs/recipes/slurm-shards.sh 100000 runs/shards --chunk 1024)
#   sbatch --dependency=afterok:$job --wrap "python -m surrogate merge runs/all.h5 runs/shards/*.h5"
# Arguments: hops a shard, folder, options of `generate`. A requeued or resubmitted shard goes on where it was.
#SBATCH --job-name=hops --cpus-per-task=1 --mem=1G --requeue --open-mode=append --output=hops-%A-%a.log
set -eu
hops=$1 folder=$2
shift 2
exec python -m surrogate generate "$folder/shard$SLURM_ARRAY_TASK_ID.h5" \
    --hops "$hops" --first $((SLURM_ARRAY_TASK_ID * hops)) --threads 1 "$@"
