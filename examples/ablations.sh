#!/bin/sh
# The encoder-decoder's curves (docs/accuracy.md): a short training for each line of the table below, then its time and
# quality on held-out rooms, then charts. Can be stopped and started again: finished runs stay, a begun one goes on.
#   sh examples/ablations.sh [FOLDER for runs and rooms, default out/ablations] [STEPS, default 400]
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
folder=${1:-$root/out/ablations}
steps=${2:-400}
program=${VDB_COMPLETE:-$root/build/release/vdb_complete}
results=$root/docs/results/ablations.csv
mkdir -p "$folder/runs"

# run NAME SEED [SET...]: trains, validates on 12 held-out rooms on the way.
run() {
  name=$1-s$2 seed=$2
  shift 2
  out=$folder/runs/$name.safetensors
  log=$out.work/log.csv
  if [ -f "$log" ] && [ "$(tail -n 1 "$log" | cut -d, -f1)" = "$steps" ]; then return; fi
  resume=
  [ -f "$out.work/checkpoint.safetensors" ] && resume=--resume
  sets=
  for change in "$@"; do sets="$sets --set $change"; done
  echo "$name" >&2
  # shellcheck disable=SC2086  # one word each
  "$program" train encoder -o "$out" --cache "$folder/rooms" --rooms 120 --steps "$steps" --rate 2e-3 --threads 1 --seed "$seed" \
    $resume $sets >"$out.txt" 2>"$out.err"
}

run base 1
run unguided 1 guide_alpha=1
run m27 1 gaussians_per_voxel=27
run dim32 1 latent_dim=32
run beta1e-2 1 kl_weight=1e-2
run unguided 2 guide_alpha=1
run base 2
run m1 1 gaussians_per_voxel=1
run fp0 1 false_positives=0
run levels0 1 levels=0
run levels2 1 levels=2
run width48 1 width=48 voxel_width=24
run width192 1 width=192 voxel_width=96 heads=6
run blocks1 1 blocks=1 decoder_blocks=1
run blocks4 1 blocks=4 decoder_blocks=4
run voxel20cm 1 voxel_m=0.2
run m64 1 gaussians_per_voxel=64
run fp100 1 false_positives=1.0
run dim16 1 latent_dim=16
run dim128 1 latent_dim=128
run beta1e-3 1 kl_weight=1e-3
run beta1e-1 1 kl_weight=1e-1
run levels2-fp0 1 levels=2 false_positives=0
run levels2-fp100 1 levels=2 false_positives=1.0
run voxel5cm 1 voxel_m=0.05
run guided-log 1 guide_log_counts=true
