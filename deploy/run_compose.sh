#!/usr/bin/env bash
# Run the quarter car in containers, and look whether its results have come out on this host: the
# bytes of a run in one process.
# Exit code 77: there is no Docker engine here.
set -euo pipefail
cd "$(dirname "$0")/.."

if ! docker compose version >/dev/null 2>&1; then
    echo "skipped: there is no docker compose here" >&2
    exit 77
fi
if ! docker info >/dev/null 2>&1; then
    echo "skipped: no Docker engine answers" >&2
    exit 77
fi

mkdir -p compose_results
rm -rf compose_results/logs compose_results/in_process compose_results/*.csv compose_results/*.json compose_results/*.png
DOUBLESTEP_UID="$(id -u)"
DOUBLESTEP_GID="$(id -g)"
export DOUBLESTEP_UID DOUBLESTEP_GID
trap 'docker compose down --volumes --timeout 10' EXIT
docker compose up --build --abort-on-container-exit --exit-code-from master
grep -q '"outcome": "completed"' compose_results/summary.json
docker compose run --rm --no-deps master \
    master-node run displacement.toml --in-process --output /results/in_process
cmp compose_results/results.csv compose_results/in_process/results.csv
cmp compose_results/steps.csv compose_results/in_process/steps.csv
echo "results in compose_results"
