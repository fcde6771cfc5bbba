"""A cluster of one node: sbatch, srun, sacct and scontrol are scripts, submitit is itself."""

# Jobs are scripts in $CLUSTER, named by their number; their states are in files beside them.
SBATCH = """#!/bin/bash
grep -q -- '--partition=closed' "$1" && { echo 'sbatch: error: invalid partition specified: closed' >&2; exit 1; }
number=$((100 + $(ls "$CLUSTER" | grep -c '\\.sh$')))
cp "$1" "$CLUSTER/$number.sh"
start_job $number > /dev/null 2>&1 &
echo "Submitted batch job $number"
"""
START = """#!/bin/bash
export SLURM_JOB_ID=$1 SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0
export SLURM_JOB_NODELIST=node7
echo RUNNING > "$CLUSTER/$1.state"
bash "$CLUSTER/$1.sh" && echo COMPLETED > "$CLUSTER/$1.state" || echo FAILED > "$CLUSTER/$1.state"
[ -e "$CLUSTER/$1.requeue" ] && mv "$CLUSTER/$1.requeue" "$CLUSTER/$1.requeued" && exec start_job $1
"""
SRUN = """#!/bin/bash
while [[ $1 == --* ]]; do
    case $1 in
        --output) output=$2; shift 2;;
        --error) error=$2; shift 2;;
        *) shift;;
    esac
done
fill() { sed "s/%j/$SLURM_JOB_ID/; s/%t/0/" <<< "$1"; }
exec "$@" >> "$(fill "$output")" 2>> "$(fill "$error")"
"""
SACCT = """#!/bin/bash
echo 'JobID|State|NodeList'
for state in "$CLUSTER"/*.state; do echo "$(basename "$state" .state)|$(cat "$state")|node7"; done
"""
SQUEUE = """#!/bin/bash
case "$*" in
    *PENDING*) echo '100|PartitionTimeLimit'; echo '7|Priority';;
    *) for state in "$CLUSTER"/*.state; do echo "$(basename "$state" .state)|$(cat "$state")"; done;;
esac
"""
SCONTROL = """#!/bin/bash
[ "$1" = requeue ] && touch "$CLUSTER/$2.requeue"
"""
FLAGS = ["--device", "cpu", "--response", "srgb", "--iterations", "200", "--preset", "fast", "--blocks", "2"]
SCRIPTS = {"sbatch": SBATCH, "start_job": START, "srun": SRUN, "sacct": SACCT, "squeue": SQUEUE, "scontrol": SCONTROL}
