#!/usr/bin/env bash
# Runs a fit on a Ray cluster that is up already, and follows it until it ends.
# Needs here: ray[default], in the cluster's version, and the cluster's token.
set -euo pipefail

# ---- fill in -----------------------------------------------------------------------------------
address='FILL_IN'      # of the head's dashboard, such as http://127.0.0.1:8265 through a tunnel
token_file='FILL_IN'   # holds the cluster's token and nothing else; chmod 600
folder='FILL_IN'       # here: config, FMU and data, all of which are sent to the cluster
config='FILL_IN'       # the config, as a path from that folder
out='FILL_IN'          # there: where the run is written to; a folder that outlives the head node
# ------------------------------------------------------------------------------------------------

for value in "$address" "$token_file" "$folder" "$config" "$out"; do
    if [ "$value" = FILL_IN ]; then
        echo "ray_job.sh: fill in the values at its top" >&2
        exit 2
    fi
done
if [ ! -s "$token_file" ]; then
    echo "ray_job.sh: $token_file must hold the cluster's token; on a node of it, \`ray" \
        "get-auth-token\` prints it" >&2
    exit 2
fi

# A file keeps the token out of the arguments and of the shell's history.
export RAY_AUTH_MODE=token
export RAY_AUTH_TOKEN_PATH=$token_file

ray job submit --address "$address" --working-dir "$folder" -- \
    cluster-est fit "$config" --out "$out" --resume executor.name=ray executor.address=auto
