#!/bin/bash
# Precomputes a scene by a Slurm job array, whose jobs share nothing but the folder; change what fits your cluster.
#
#     sbatch examples/slurm_array.sh scene.glb /shared/scene
#
# The jobs may run in any order, and one that is killed goes on where it stopped when it is submitted again. Systems that
# compute in stages, such as --bounces, need the array once for each stage: every job says what is still missing.
# The last call, without --part, computes what is left and draws the pictures.
#SBATCH --array=1-16
#SBATCH --cpus-per-task=4
#SBATCH --mem=8G
#SBATCH --time=02:00:00

set -euo pipefail
relight=(python -m jaxprt relight "$1" --output "$2" --system lobe)
"${relight[@]}" --part "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
if [ "$SLURM_ARRAY_TASK_ID" = 1 ]; then
    sbatch --dependency="afterok:$SLURM_ARRAY_JOB_ID" --cpus-per-task=4 --mem=8G --wrap "$(printf '%q ' "${relight[@]}")"
fi
