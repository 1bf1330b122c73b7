#!/bin/sh
# The completer's study: every method on held-out rooms with 1 to 12 views in, and on example homes; charts against the
# number of views (bars: standard error over the same rooms), the reliability of the stored probabilities, tau against the
# number of views, and tables. Can be stopped and started again: finished parts stay; delete their .jsonl after the weights
# have changed. One thread, well over an hour. The charts need gnuplot.
#   sh examples/study.sh [FOLDER, default docs: writes completion.svg, tau.svg, results/completion.md, results/completion-*.jsonl]
# ROOMS (1-16, with several tau), MORE_ROOMS (17-64) and HOMES (0-23, at two views) choose other scenes, VIEWS other numbers
# of views. PARTS="rooms:1-16/2 ..." makes just those parts, so that several processes can share the work; CHARTS_ONLY=1
# makes none: charts and tables of what is there.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
folder=${1:-$root/docs}
program=${VDB_LAB:-$root/build/release/vdb_lab}
views="${VIEWS:-1 2 4 8 12}"
taus=".1 .2 .3 .4 .5 .6"
some=rooms:${ROOMS:-1-16} more=rooms:${MORE_ROOMS:-17-64} all_homes=homes:${HOMES:-0-23}
data=$root/out/study
mkdir -p "$folder/results" "$data"
results=$(CDPATH='' cd -- "$folder/results" && pwd -P)

# fileOf SCENES VIEWS: where their lines are.
fileOf() { echo "$results/completion-$(echo "$1" | tr : _)-$2.jsonl"; }

# part SCENES VIEWS
part() {
  if [ -s "$(fileOf "$1" "$2")" ]; then return; fi
  echo "$1, $2 views" >&2
  sweep=
  [ "$1" = "$some" ] && sweep="--taus $taus"
  # shellcheck disable=SC2086  # one word each
  "$program" eval --scenes "$1" --views "$2" --threads 1 $sweep --json 2>>"$data/eval.log" >"$data/part-$$.jsonl"
  mv "$data/part-$$.jsonl" "$(fileOf "$1" "$2")"
}

# statistics FILE...: a line "method score scenes mean deviation" for each number of the scenes' results.
statistics() {
  cat "$@" | grep -v -e '"scene":"mean"' -e '"scene":"std"' -e '"reliability"' | awk '
    { match($0, "\"method\":\"[^\"]*"); method = substr($0, RSTART + 10, RLENGTH - 10)
      rest = $0
      while (match(rest, "\"[a-z0-9_]+\":-?[0-9][-+0-9.e]*")) {
        split(substr(rest, RSTART + 1, RLENGTH - 1), pair, "\":")
        rest = substr(rest, RSTART + RLENGTH)
        at = method " " pair[1]
        count[at]++; sum[at] += pair[2]; square[at] += pair[2] * pair[2]
      } }
    END { for (at in count) {
      n = count[at]; mean = sum[at] / n; variance = n > 1 ? (square[at] - n * mean * mean) / (n - 1) : 0
      print at, n, mean, sqrt(variance > 0 ? variance : 0) } }'
}

# table FILE...: Markdown, mean +- standard deviation.
table() {
  statistics "$@" | awk '
    { mean[$1, $2] = $4; deviation[$1, $2] = $5 }
    END {
      methods = split("observed pixel-aligned nearest box completed oracle-occupancy", method, " ")
      scores = split("psnr ssim flip precision recall shell_recall furniture_recall f1 iou outside leak ece seconds", score, " ")
      head = "| method | PSNR | SSIM | FLIP | precision | recall | of the shell | of furniture | F1 | IoU | outside | leak | ECE | s |"
      print head; gsub("[^|]+", "---", head); print head
      for (m = 1; m <= methods; ++m) {
        row = "| " method[m]
        for (s = 1; s <= scores; ++s) {
          at = method[m] SUBSEP score[s]
          digits = score[s] == "psnr" || score[s] == "seconds" ? 2 : score[s] == "outside" ? 0 : 3
          row = row " | " (at in mean ? sprintf("%.*f +- %.*f", digits, mean[at], digits, deviation[at]) : "")
        }
        print row " |"
      } }'
}

# scenes FILE...: how many.
scenes() { cat "$@" | grep '"method":"completed"' | grep -v -e '"scene":"mean"' -e '"scene":"std"' -e '"reliability"' -c; }

# reliability FILE...: a line "mean-probability share-in-truth nodes" a bin, over all scenes.
reliability() {
  cat "$@" | grep '"reliability"' | grep -v '"scene":"mean"' | sed 's/.*"reliability":\[\[//; s/\]\].*//; s/\],\[/ /g' | awk '
    { for (i = 1; i <= NF; ++i) { split($i, bin, ","); count[i] += bin[1]; sum[i] += bin[2]; hits[i] += bin[3] } }
    END { for (i = 1; i <= 10; ++i) if (count[i] > 0) print sum[i] / count[i], hits[i] / count[i], count[i] }'
}

if [ -n "${PARTS:-}" ]; then
  for p in $PARTS; do part "${p%/*}" "${p#*/}"; done
  exit
fi
if [ -z "${CHARTS_ONLY:-}" ]; then
  for n in 2 $views; do part "$some" "$n"; part "$more" "$n"; done
  part "$all_homes" 2
fi

# roomsOf VIEWS: the files there are.
roomsOf() { for part in "$some" "$more"; do if [ -s "$(fileOf "$part" "$1")" ]; then fileOf "$part" "$1"; fi; done; }
rooms=$(roomsOf 2)
homes=$(fileOf "$all_homes" 2)
# shellcheck disable=SC2086  # two files
{
  printf 'Two views in, mean +- standard deviation over scenes (sh examples/study.sh).\n\n'
  printf '%s rooms:\n\n' "$(scenes $rooms)"
  table $rooms
  printf '\n%s rooms of example homes:\n\n' "$(scenes "$homes")"
  table "$homes"
  for n in $views; do
    # shellcheck disable=SC2046  # two files
    [ "$n" = 2 ] || { printf '\n%s rooms, %s views in:\n\n' "$(scenes $(roomsOf "$n"))" "$n"; table $(roomsOf "$n"); }
  done
} >"$data/completion.md"
mv "$data/completion.md" "$results/completion.md"

rm -f "$data"/curve-* "$data"/tau-*
for n in $views; do
  # shellcheck disable=SC2046  # two files
  statistics $(roomsOf "$n") | while read -r method score count mean deviation; do
    case $method in
      completed-tau-*) echo "$n ${method#completed-tau-} $mean" >>"$data/tau-$score" ;;
      *) echo "$n $count $mean $deviation" | awk '{ print $1, $3, $4 / sqrt($2) }' >>"$data/curve-$method-$score" ;;
    esac
  done
done
# shellcheck disable=SC2086
reliability $rooms >"$data/curve-rooms"
reliability "$homes" >"$data/curve-homes"
cd "$data"
gnuplot <<'PLOT'
set terminal svg size 1350,800 font "sans,13" background "white"
set output "completion.svg"
set multiplot layout 2,3 margins .05,.98,.08,.88 spacing .06,.15
set grid
set linetype 5 lc rgb "#d62728"
methods = "observed pixel-aligned nearest box completed oracle-occupancy"
scores = "psnr ssim flip f1 leak"
titles = "'PSNR [dB]' 'SSIM' 'FLIP (low is good)' 'Strict F1 of unseen nodes' 'Leak (low is good)'"
set xlabel "views in"
set offsets .5, .5, 0, 0
unset key
do for [m = 1:words(methods)] { set label word(methods, m) at screen .15 * m - .06, screen .97 textcolor lt m font ",14" }
do for [s = 1:words(scores)] {
  set title word(titles, s)
  plot for [m = 1:words(methods)] "curve-".word(methods, m)."-".word(scores, s) using 1:2:3 \
    with yerrorlines lw 1.5 pt 7 ps .5 lc m
  unset label
}
set title "Reliability of generated nodes, two views"
set xlabel "stored probability"; set ylabel "share that is there"
set offsets 0, 0, 0, 0
set xrange [0:1]; set yrange [0:1]
set key top left font ",10"
plot x with lines lc "gray" dt 2 title "calibrated", "curve-rooms" with linespoints lw 1.5 pt 7 ps .5 lc 5 title "rooms", \
  "curve-homes" with linespoints lw 1.5 pt 7 ps .5 lc 3 title "homes"
PLOT
gnuplot <<'PLOT'
set terminal svg size 1350,400 font "sans,13" background "white"
set output "tau.svg"
set multiplot layout 1,4 margins .05,.98,.16,.88 spacing .06
scores = "psnr ssim flip f1"
titles = "'PSNR [dB]' 'SSIM' 'FLIP (low is good)' 'Strict F1 of unseen nodes'"
formats = "'%.2f' '%.3f' '%.3f' '%.3f'"
set xlabel "views in"; set ylabel "tau"
unset key; unset colorbox
set xrange [-.5:4.5]; set yrange [.05:.65]; set cbrange [0:1]; unset grid
set xtics ("1" 0, "2" 1, "4" 2, "8" 3, "12" 4)
place(n) = n > 8 ? 4 : n > 4 ? 3 : n > 2 ? 2 : n > 1 ? 1 : 0
do for [s = 1:4] {
  set title word(titles, s)
  # Colours are per number of views: darkest the best tau of its column.
  if (s == 3) { set palette defined (0 "#6baed6", 1 "white") } else { set palette defined (0 "white", 1 "#6baed6") }
  plot "< awk 'NR == FNR { if (!($1 in low) || $3 < low[$1]) low[$1] = $3; if (!($1 in high) || $3 > high[$1]) high[$1] = $3; next } { print $1, $2, $3, (high[$1] == low[$1] ? 0 : ($3 - low[$1]) / (high[$1] - low[$1])) }' tau-".word(scores, s)." tau-".word(scores, s) \
    using (place($1)):2:(.5):(.05):4 with boxxyerror fs solid noborder lc palette, "tau-".word(scores, s) using (place($1)):2:(sprintf(word(formats, s), $3)) with labels font ",11"
}
PLOT
mv completion.svg tau.svg "$results/.."
cat "$results/completion.md"
