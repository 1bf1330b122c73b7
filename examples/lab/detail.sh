#!/bin/sh
# How sharp what was seen is, for how many seconds of fitting (docs/accuracy.md): rooms with 2, 4 and 12 views, and the
# kitchen with 4 and 12 where it is there. Beside it the decoder, voxel means, one Gaussian a pixel, and Gaussians optimised
# for 30 s. Some 45 minutes on one core; it resumes. The chart needs gnuplot.
#   sh examples/lab/detail.sh [FOLDER with rgbd_redkitchen, default ../shared/data] [ROOMS, default rooms:1-4]
# Writes docs/detail.svg and docs/results/detail.csv.
. "$(dirname -- "$0")/common.sh"
data=${1:-$root/../shared/data}
rooms=${2:-rooms:1-4}
scratch "$root/out/detail"

# job NAME SECONDS SCENES VIEWS [OPTION...]: adds "NAME SECONDS" to `jobs`; the first SECONDS carry the baselines.
jobs='' first=.01
job() {
  name="$1 $2" seconds=$2 scenes=$3 views=$4 optimise=0
  shift 4
  [ "$seconds" != $first ] || optimise=30
  evaluate "$folder/$name.jsonl" --reconstruct --scenes "$scenes" --views "$views" --detail "$seconds" \
    --optimise $optimise "$@"
  jobs="$jobs$name=$folder/$name.jsonl
"
}
kinds=
for views in 2 4 12; do
  kinds="$kinds rooms-$views"
  for seconds in $first .25 .5 1 2 5 10 30; do job "rooms-$views" $seconds "$rooms" $views; done
done
if [ -d "$data/rgbd_redkitchen" ]; then
  kinds="$kinds kitchen-4 kitchen-12"
  for seconds in $first .25 .5 1 2 5 10 30; do
    job kitchen-4 $seconds "$data/rgbd_redkitchen" 4 --frames 0,6,12,18
  done
  for seconds in $first .25 .5 1 2 5 10 30; do
    job kitchen-12 $seconds "$data/rgbd_redkitchen" 12 --frames 0,2,4,6,8,10,12,14,16,18,20,22
  done
fi
scores="input_psnr other_seen_psnr other_psnr other_ssim other_flip encode_seconds gaussians"
# shellcheck disable=SC2086  # one word a score
compare "$jobs" --method detail --scores $scores --csv "$results/detail.csv"
for method in reconstructed voxel-mean pixel-aligned optimised; do
  baselines=
  for kind in $kinds; do
    baselines="$baselines$kind $method=$folder/$kind $first.jsonl
"
  done
  # shellcheck disable=SC2086
  compare "$baselines" --method $method --scores $scores --csv "$folder/baseline.csv"
  tail -n +2 "$folder/baseline.csv" >>"$results/detail.csv"
done
cd "$results"
gnuplot <<'PLOT'
set terminal svg size 900,420 font "sans,13" background "white"
set output "../detail.svg"
set datafile separator ","; set datafile columnheaders
of(kind, column_) = word(strcol("configuration"), 1) eq kind ? column(column_) : NaN
budget(text) = strstrt("0123456789.", substr(text, 1, 1)) > 0
fitted(kind, column_) = budget(word(strcol("configuration"), 2)) ? of(kind, column_) : NaN
optimised(kind, column_) = word(strcol("configuration"), 2) eq "optimised" ? of(kind, column_) : NaN
kinds = "rooms-2 rooms-4 rooms-12 kitchen-4 kitchen-12"
set linetype 5 lc rgb "#d62728"
set multiplot layout 1,2
set grid; set key outside bottom center horizontal; set logscale x; set offsets graph 0, 0, .05, .05
set xlabel "measured seconds of placing and fitting, one core"; set ylabel "PSNR where views saw [dB]"
do for [score in "input_psnr other_seen_psnr"] {
  set title score eq "input_psnr" ? "Input views" : "Other views"
  plot for [i=1:words(kinds)] "detail.csv" using (column("encode_seconds")):(fitted(word(kinds, i), score)) \
         with linespoints lc i pt 7 ps .5 title word(kinds, i), \
       for [i=1:words(kinds)] "detail.csv" using (column("encode_seconds")):(optimised(word(kinds, i), score)) \
         with points lc i pt 4 ps 1.2 notitle
}
PLOT
