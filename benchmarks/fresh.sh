#!/usr/bin/env bash
# Fresh clones of commits, by turns: seconds of set-up, of `make scene=office0` from nothing to the report, and of a training
# of one step with all before it made and no kernel compiled: what stands between the planner and the first step, at most.
#
#   bash benchmarks/fresh.sh OLD NEW        # SCENE=office0 ROUNDS=1; packages come from the package manager's cache
set -euo pipefail
scene=${SCENE:-office0}
here=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
unset CHEBSPLAT_WORK

timed() {  # seconds of a command, whose words go to a file that is shown where it fails
    local began=$EPOCHREALTIME
    "$@" >"$folder/words" 2>&1 || { tail -n 30 "$folder/words" >&2; exit 1; }
    awk -v a="$began" -v b="$EPOCHREALTIME" 'BEGIN { printf "%.1f", b - a }'
}

mkdir -p "$here/build/bench"
table=$here/build/bench/fresh.csv
echo "commit,round,setup_s,scene_s,first_step_s" >"$table"
for round in $(seq "${ROUNDS:-1}"); do
    for commit in "$@"; do
        clone=$folder/clone
        rm -rf "$clone"
        git clone -q "$here" "$clone"
        git -C "$clone" checkout -q "$commit"
        setup=$(timed make -C "$clone" setup)
        whole=$(CHEBSPLAT_CACHE=$folder/whole-$round-$commit timed make -C "$clone" scene="$scene")
        first=$(CHEBSPLAT_CACHE=$folder/first-$round-$commit timed make -C "$clone" scene="$scene" stage=train set=train.steps=1)
        echo "$commit,$round,$setup,$whole,$first" | tee -a "$table"
    done
done
