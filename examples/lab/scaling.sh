#!/bin/sh
# What time and memory follow (docs/performance.md): the volume at constant content (the bundled views with growing
# margins), the content at constant volume (a whole example home, views in one to eight of its rooms), and a corridor: the
# home in windows. Some ten minutes on two cores, most of it rendering the homes. The chart needs gnuplot.
#   sh examples/lab/scaling.sh [FOLDER for views and results, default out/scaling]
# Writes docs/scaling.svg and docs/results/scaling.csv.
. "$(dirname -- "$0")/common.sh"
scratch "${1:-$root/out/scaling}"

# The rooms of one example home share a frame: homes 8 to 15, 11 x 10 m. Their views as one folder.
home=$folder/home
[ -f "$folder/homes/15/transforms.json" ] ||
  "$lab" make_rooms homes --views 3 -o "$folder/homes"
mkdir -p "$home"
for room in 8 9 10 11 12 13 14 15; do ln -sfn "$folder/homes/$room" "$home/$room"; done
{
  sed '/"frames": \[/q' "$home/8/transforms.json"
  for room in 8 9 10 11 12 13 14 15; do
    sed -n '/"frames": \[/,/^ \]/{ //d; s#"\(color\|depth\)/#"'$room'/\1/#; p; }' "$home/$room/transforms.json" |
      if [ $room = 15 ]; then cat; else sed '$s/$/,/'; fi
  done
  sed -n '/^ \]/,$p' "$home/8/transforms.json"
} >"$folder/transforms.json"
mv "$folder/transforms.json" "$home/transforms.json"

# job KIND NUMBER VIEWS [OPTION...]: a result "KIND NUMBER"; adds a line to `jobs`.
jobs=
job() {
  name="$1 $2" views=$3
  shift 3
  "$program" "$views" "$@" -o "$folder/$name.vdb" --json 2>>"$folder/log" >"$folder/$name.json"
  jobs="$jobs$name=$folder/$name.json
"
}
for margin in .5 1 1.5 2 3 4 6 10; do job margin $margin "$root/examples/two_views" --margin $margin; done
bounds="-1.5 -11.5 -0.5 12.5 1.5 3.2"
last=2
for rooms in 1 2 3 4 5 6 7 8; do
  # shellcheck disable=SC2086  # six numbers
  job rooms $rooms "$home" --frames 0-$last --bounds $bounds
  last=$((last + 3))
done
compare "$jobs" --method '' --scores seconds peak_mb observed_tokens generated_tokens --csv "$results/scaling.csv"
cd "$results"
gnuplot <<'PLOT'
set terminal svg size 900,380 font "sans,13" background "white"
set output "../scaling.svg"
set datafile separator ","; set datafile columnheaders
number(kind) = word(strcol("configuration"), 1) eq kind ? word(strcol("configuration"), 2) + 0 : NaN
set multiplot layout 1,2
set grid; set key top left
set yrange [0:*]; set xrange [0:*]
set ylabel "seconds, views to files"; set y2label "generated tokens"; set y2tics; set ytics nomirror; set y2range [0:*]
set title "Two views, a growing volume"; set xlabel "margin around what was seen [m]"
plot "scaling.csv" using (number("margin")):"seconds" with linespoints pt 7 title "seconds", "" using (number("margin")):"generated_tokens" axes x1y2 with linespoints pt 6 title "tokens"
set title "14 x 13 x 3.7 m, more of it seen"; set xlabel "rooms with three views each"
plot "scaling.csv" using (number("rooms")):"seconds" with linespoints pt 7 title "seconds", "" using (number("rooms")):"generated_tokens" axes x1y2 with linespoints pt 6 title "tokens"
PLOT
