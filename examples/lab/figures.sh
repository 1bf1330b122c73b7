#!/bin/sh
# Makes the figures that README and docs quote of the encoder-decoder and of real captures, and the README's picture; those
# of the completer are study.sh's. Results in docs/results/. Takes about half an hour.
#   sh examples/lab/figures.sh [FOLDER with rgbd_redkitchen, default ../shared/data]
. "$(dirname -- "$0")/common.sh"
data=${1:-$root/../shared/data}
scratch "$root/out"
: >"$folder/figures.log"

"$lab" eval --reconstruct --scenes rooms:1-8 --json 2>>"$folder/figures.log" >"$results/rooms_reconstruct.jsonl"
"$lab" eval --reconstruct --scenes homes:0-8 --json 2>>"$folder/figures.log" >"$results/homes_reconstruct.jsonl"
"$program" "$root/examples/two_views" -o "$folder/two_views.vdb" --json 2>>"$folder/figures.log" >"$results/two_views.json"
cp "$folder/two_views.png" "$root/docs/two_views.png"
if [ -d "$data/rgbd_redkitchen" ]; then
  "$program" "$data/rgbd_redkitchen" --frames 0,6,12,18 -o "$folder/redkitchen.vdb" --json 2>>"$folder/figures.log" \
    >"$results/redkitchen_4_views.json"
  "$lab" eval --scenes "$data/rgbd_redkitchen" --frames 0,6,12,18 --json 2>>"$folder/figures.log" \
    >"$results/redkitchen_eval.jsonl"
  for capture in redkitchen diningroom livingroom_rendered; do
    views=12
    [ "$capture" = redkitchen ] || views=3  # of five frames
    "$lab" eval --reconstruct --views "$views" --scenes "$data/rgbd_$capture" --json 2>>"$folder/figures.log" \
      >"$results/${capture}_reconstruct.jsonl"
  done
fi
"$lab" tables "$results"/*_reconstruct.jsonl --scores input_psnr other_psnr other_ssim other_flip voxel_f1 leak encode_seconds
