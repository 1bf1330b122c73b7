#!/bin/sh
# The completer's study: every method on held-out rooms with 1 to 12 views in, on example homes and on real captures; charts
# against the number of views (bars: standard error over the same rooms), the reliability of the stored probabilities, and
# tables. Can be stopped and started again: finished parts stay; delete their .jsonl after the weights have changed. One
# thread, about an hour. The charts need gnuplot.
#   sh examples/lab/study.sh [FOLDER, default docs: writes completion.svg, and results/completion.md, completion.csv,
#   reliability.csv, completion-*.jsonl]
# ROOMS (1-8, with all numbers of views), MORE_ROOMS (9-32) and HOMES (0-7, at two views) choose other scenes, VIEWS other
# numbers of views, DATA the folder of the captures. TAUS=".3 .4 .5 .6 .7" completes ROOMS with these thresholds too and
# draws tau.svg. PARTS="rooms:1-8/2 ..." makes just those parts, so that several processes can share the work;
# CHARTS_ONLY=1 makes none: charts and tables of what is there.
. "$(dirname -- "$0")/common.sh"
charts=${1:-$root/docs}
views="${VIEWS:-1 2 4 12}"
taus=${TAUS:-}
some=rooms:${ROOMS:-1-8} more=rooms:${MORE_ROOMS:-9-32} all_homes=homes:${HOMES:-0-7}
data=${DATA:-$root/../shared/data}
scratch "$charts/results"
results=$folder
scratch "$root/out/study"

# fileOf SCENES VIEWS: where their lines are.
fileOf() { echo "$results/completion-$(echo "$1" | tr : _)-$2.jsonl"; }

# part SCENES VIEWS
part() {
  sweep=
  [ "$1" = "$some" ] && sweep=${taus:+--taus $taus}
  # shellcheck disable=SC2086  # one word each
  evaluate "$(fileOf "$1" "$2")" --scenes "$1" --views "$2" $sweep
}

# capture NAME FRAMES: judged by its other frames.
capture() {
  [ ! -d "$data/rgbd_$1" ] ||
    evaluate "$results/completion-$1.jsonl" --scenes "$data/rgbd_$1" --frames "$2"
}

if [ -n "${PARTS:-}" ]; then
  for p in $PARTS; do part "${p%/*}" "${p#*/}"; done
  exit
fi
if [ -z "${CHARTS_ONLY:-}" ]; then
  for n in 2 $views; do part "$some" "$n"; done
  part "$more" 2
  part "$all_homes" 2
  capture redkitchen 0,6,12,18
  capture diningroom 0,2,4
  capture livingroom_rendered 0,2,4
fi

# The files there are: two views first, then the homes, then other numbers of views.
set --
for part in "$some/2" "$more/2" "$all_homes/2" $(for n in $views; do [ "$n" = 2 ] || echo "$some/$n"; done); do
  file=$(fileOf "${part%/*}" "${part#*/}")
  if [ -s "$file" ]; then set -- "$@" "$file"; fi
done
captures=
for name in redkitchen diningroom livingroom_rendered; do
  file=$results/completion-$name.jsonl
  if [ -s "$file" ]; then captures="$captures $file"; fi
done
{
  printf 'Mean +- standard deviation over scenes (sh examples/lab/study.sh).\n\n'
  "$lab" tables "$@" --csv "$results/completion.csv" --reliability "$results/reliability.csv"
  printf '\nReal captures, judged by their other frames.\n\n'
  # shellcheck disable=SC2086  # one word each
  for file in $captures; do
    "$lab" tables "$file" --scores mean_psnr mean_ssim mean_flip near_precision near_recall near_f1 blocked right open ece
  done
} >"$folder/completion.md"
mv "$folder/completion.md" "$results/completion.md"

cd "$results"
gnuplot <<'PLOT'
set terminal svg size 1350,800 font "sans,13" background "white"
set output "../completion.svg"
set datafile separator ","; set datafile columnheaders
of(kind, method) = strcol("kind") eq kind && strcol("method") eq method
set multiplot layout 2,3 margins .05,.98,.08,.88 spacing .06,.15
set grid
set linetype 5 lc rgb "#d62728"
methods = "observed pixel-aligned nearest box completed oracle-occupancy"
scores = "mean_psnr mean_flip near_f1 f1 leak"
titles = "'PSNR over mean colour [dB]' 'FLIP (low is good)' 'Near F1 of unseen voxels' 'Strict F1 of unseen nodes' 'Leak (low is good)'"
set xlabel "views in"
set offsets .5, .5, 0, 0
unset key
do for [m = 1:words(methods)] { set label word(methods, m) at screen .15 * m - .06, screen .97 textcolor lt m font ",14" }
do for [s = 1:words(scores)] {
  set title word(titles, s)
  plot for [m = 1:words(methods)] "completion.csv" \
    using (of("rooms", word(methods, m)) ? column("views") : NaN):(column(word(scores, s))):(column(word(scores, s)."_deviation") / sqrt(column("scenes"))) \
    with yerrorlines lw 1.5 pt 7 ps .5 lc m
  unset label
}
set title "Reliability of generated nodes, two views"
set xlabel "stored probability"; set ylabel "share that is there"
set offsets 0, 0, 0, 0
set xrange [0:1]; set yrange [0:1]
set key top left font ",10"
two(kind) = of(kind, "completed") && column("views") == 2 ? column("probability") : NaN
plot x with lines lc "gray" dt 2 title "calibrated", "reliability.csv" using (two("rooms")):"share" with linespoints lw 1.5 pt 7 ps .5 lc 5 title "rooms", \
  "" using (two("homes")):"share" with linespoints lw 1.5 pt 7 ps .5 lc 3 title "homes"
PLOT
[ -z "$taus" ] || gnuplot <<'PLOT'
set terminal svg size 1350,400 font "sans,13" background "white"
set output "../tau.svg"
set datafile separator ","; set datafile columnheaders
set multiplot layout 1,4 margins .05,.98,.16,.88 spacing .06
scores = "psnr ssim flip f1"
titles = "'PSNR [dB]' 'SSIM' 'FLIP (low is good)' 'Strict F1 of unseen nodes'"
formats = "'%.2f' '%.3f' '%.3f' '%.3f'"
set xlabel "views in"; set ylabel "tau"
unset key; unset colorbox
set xrange [-.5:4.5]; set yrange [.05:.65]; set cbrange [0:1]; unset grid
set xtics ("1" 0, "2" 1, "4" 2, "8" 3, "12" 4)
place(n) = n > 8 ? 4 : n > 4 ? 3 : n > 2 ? 2 : n > 1 ? 1 : 0
head = "completed-tau-"
tau(kind, method) = kind eq "rooms" && substr(method, 1, strlen(head)) eq head ? substr(method, strlen(head) + 1, strlen(method)) + 0 : NaN
array low[5]; array high[5]
keep(p, v) = (low[p] = v < low[p] ? v : low[p], high[p] = v > high[p] ? v : high[p], v)
share(p, v) = high[p] == low[p] ? 0 : (v - low[p]) / (high[p] - low[p])
do for [s = 1:4] {
  score = word(scores, s)
  set title word(titles, s)
  # Colours are per number of views: darkest the best tau of its column.
  if (s == 3) { set palette defined (0 "#6baed6", 1 "white") } else { set palette defined (0 "white", 1 "#6baed6") }
  do for [p = 1:5] { low[p] = 1e9; high[p] = -1e9 }
  set table $ranges
  plot "completion.csv" using (tau(strcol("kind"), strcol("method")) > 0 ? keep(place(column("views")) + 1, column(score)) : NaN)
  unset table
  plot "completion.csv" using (place(column("views"))):(tau(strcol("kind"), strcol("method"))):(.5):(.05):(share(place(column("views")) + 1, column(score))) with boxxyerror fs solid noborder lc palette, \
    "" using (place(column("views"))):(tau(strcol("kind"), strcol("method"))):(sprintf(word(formats, s), column(score))) with labels font ",11"
}
PLOT
cat completion.md
