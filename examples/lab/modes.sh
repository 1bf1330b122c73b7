#!/bin/sh
# The ways to run the completer that is shipped (docs/notes/accuracy.md): latents as means or drawn by the diffusion head,
# generated tokens as context or not, breadth-first or random order, observed latents rewritten. Held-out rooms from two
# views, and the kitchen where it is there. Can be stopped and started again. One core, about twenty minutes.
#   sh examples/lab/modes.sh [FOLDER with rgbd_redkitchen, default ../shared/data] [ROOMS, default rooms:33-38]
# Writes docs/results/modes.md.
. "$(dirname -- "$0")/common.sh"
data=${1:-$root/../shared/data}
rooms=${2:-rooms:33-38}
scratch "$root/out/modes"

# mode NAME [OPTION...]: adds a line to `jobs` for rooms and kitchen each.
in_rooms='' in_kitchen=''
mode() {
  name=$1
  shift
  evaluate "$folder/rooms $name.jsonl" --scenes "$rooms" --views 2 "$@"
  in_rooms="$in_rooms$name=$folder/rooms $name.jsonl
"
  [ -d "$data/rgbd_redkitchen" ] || return 0
  evaluate "$folder/kitchen $name.jsonl" --scenes "$data/rgbd_redkitchen" --frames 0,6,12,18 "$@"
  in_kitchen="$in_kitchen$name=$folder/kitchen $name.jsonl
"
}

mode mean
mode 'drawn, temperature .5' --sampling-steps 10 --temperature .5
mode 'drawn, temperature 1' --sampling-steps 10
mode 'generated context' --generated-context
mode 'generated context, random order' --generated-context --random-order
mode 'generated context, drawn at .5' --generated-context --sampling-steps 10 --temperature .5
mode 'observed rewritten' --refine-observed
for jobs in "$in_rooms" "$in_kitchen"; do
  [ -n "$jobs" ] || continue
  compare "$jobs" --method completed \
    --scores mean_psnr unseen_psnr unseen_flip near_precision near_recall near_f1 f1 blocked leak gaussians
  echo
done >"$folder/table.md"
mv "$folder/table.md" "$results/modes.md"
cat "$results/modes.md"
