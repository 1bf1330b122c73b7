#!/bin/sh
# How sharp what was seen is, for how many seconds of fitting (docs/accuracy.md): rooms with 2, 4 and 12 views, and the
# kitchen with 4 and 12 where it is there. Beside it the decoder, voxel means and one Gaussian a pixel. Some twenty minutes
# on two cores. The chart needs gnuplot.
#   sh examples/lab/detail.sh [FOLDER with rgbd_redkitchen, default ../shared/data] [ROOMS, default rooms:1-4]
# Writes docs/detail.svg and docs/results/detail.csv.
. "$(dirname -- "$0")/common.sh"
data=${1:-$root/../shared/data}
rooms=${2:-rooms:1-4}
scratch "$root/out/detail"

# job NAME SECONDS SCENES VIEWS [OPTION...]: adds "NAME SECONDS" to `jobs`.
jobs=
job() {
  name="$1 $2" seconds=$2 scenes=$3 views=$4
  shift 4
  [ -s "$folder/$name.jsonl" ] ||
    "$lab" eval --reconstruct --scenes "$scenes" --views "$views" --detail "$seconds" --optimise 0 "$@" --json \
      2>>"$folder/log" >"$folder/$name.draft"
  [ -s "$folder/$name.jsonl" ] || mv "$folder/$name.draft" "$folder/$name.jsonl"
  jobs="$jobs$name=$folder/$name.jsonl
"
}
for views in 2 4 12; do
  for seconds in .01 .25 .5 1 2 5; do job "rooms-$views" $seconds "$rooms" $views; done
done
if [ -d "$data/rgbd_redkitchen" ]; then
  for seconds in .01 .25 .5 1 2 5 10; do job kitchen-4 $seconds "$data/rgbd_redkitchen" 4 --frames 0,6,12,18; done
  for seconds in .01 .25 .5 1 2 5 10; do
    job kitchen-12 $seconds "$data/rgbd_redkitchen" 12 --frames 0,2,4,6,8,10,12,14,16,18,20,22
  done
fi
compare "$jobs" --method detail --scores input_psnr other_seen_psnr other_psnr other_ssim other_flip encode_seconds \
  --csv "$results/detail.csv"
cd "$results"
gnuplot <<'PLOT'
set terminal svg size 900,380 font "sans,13" background "white"
set output "../detail.svg"
set datafile separator ","; set datafile columnheaders
of(kind, column_) = word(strcol("configuration"), 1) eq kind ? column(column_) : NaN
at(kind) = word(strcol("configuration"), 1) eq kind ? real(word(strcol("configuration"), 2)) : NaN
set multiplot layout 1,2
set grid; set key bottom right; set logscale x
set xlabel "--detail [s]"; set ylabel "PSNR [dB]"
set title "Where views saw: input views"
plot for [kind in "rooms-2 rooms-4 rooms-12 kitchen-4 kitchen-12"] "detail.csv" using (at(kind)):(of(kind, "input_psnr")) with linespoints title kind
set title "Where views saw: other views"
plot for [kind in "rooms-2 rooms-4 rooms-12 kitchen-4 kitchen-12"] "detail.csv" using (at(kind)):(of(kind, "other_seen_psnr")) with linespoints title kind
PLOT
