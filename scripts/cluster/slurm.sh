#!/usr/bin/env bash
#SBATCH --job-name=cluster-est
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --exclusive
#SBATCH --time=04:00:00
#SBATCH --output=%x-%j.log
# Runs a fit on the nodes of one Slurm job: sbatch slurm.sh. Needs a virtual environment with
# cluster-est on a file system that all nodes see. --exclusive: at its end the job stops every Ray
# process of yours on its nodes. `ray symmetric-run` is there from Ray 2.52 on, as are tokens.
set -euo pipefail

# ---- fill in, besides the #SBATCH lines above --------------------------------------------------
environment='FILL_IN'  # the virtual environment
config='FILL_IN'       # the config
out='FILL_IN'          # folder to write the run to, on a file system that outlives the nodes
# ------------------------------------------------------------------------------------------------

for value in "$environment" "$config" "$out"; do
    if [ "$value" = FILL_IN ]; then
        echo "slurm.sh: fill in the values at its top" >&2
        exit 2
    fi
done
export PATH="$environment/bin:$PATH"

# A token for this job alone. srun hands it on in the environment, which other users cannot read.
RAY_AUTH_MODE=token
RAY_AUTH_TOKEN=$(python -c 'import secrets; print(secrets.token_hex(32))')
export RAY_AUTH_MODE RAY_AUTH_TOKEN
export OPENBLAS_NUM_THREADS=1
export RAY_SYMMETRIC_RUN_CLUSTER_WAIT_TIMEOUT=300 # s; a cold file system is slow

# awk reads to the end: with pipefail, a reader that leaves early makes the writer fail
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | awk 'NR == 1')
# The first IPv4 address that the head gives itself
head_address=$(srun --nodes=1 --ntasks=1 --nodelist="$head" hostname --ip-address \
    | tr ' ' '\n' | awk '/[.]/ && !found { print; found = 1 }')

srun --nodes="$SLURM_JOB_NUM_NODES" --ntasks="$SLURM_JOB_NUM_NODES" --kill-on-bad-exit=0 \
    ray symmetric-run --address "$head_address:6379" --min-nodes "$SLURM_JOB_NUM_NODES" \
    --num-cpus "$SLURM_CPUS_PER_TASK" -- \
    cluster-est fit "$config" --out "$out" --resume executor.name=ray executor.address=auto

# `ray symmetric-run` also ends with 0 if Ray did not start
if [ ! -f "$out/run.json" ]; then
    echo "slurm.sh: no fit was run; what Ray said is above" >&2
    exit 1
fi
