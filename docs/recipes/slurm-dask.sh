#!/bin/bash
# A dask cluster within one job: a worker a task; scheduler and writer run beside the workers of the first node:
#   sbatch --ntasks=200 docs/recipes/slurm-dask.sh runs/hops.h5 --hops 1000000 --chunk 1024
# Arguments: those of `generate`. A requeued or resubmitted job goes on where it was.
#SBATCH --job-name=hops --cpus-per-task=1 --mem-per-cpu=1G --requeue --open-mode=append --output=hops-%j.log
set -eu
file=$PWD/scheduler-$SLURM_JOB_ID-${SLURM_RESTART_COUNT:-0}.json
dask scheduler --port 0 --scheduler-file "$file" &
srun dask worker --scheduler-file "$file" --nthreads 1 --no-dashboard &
trap 'kill $(jobs -p); rm -f "$file"' EXIT
python -m surrogate generate "$@" --scheduler "$file"
