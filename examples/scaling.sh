#!/bin/sh
# What time and memory follow (docs/performance.md): the volume at constant content (the bundled views with growing
# margins), the content at constant volume (a whole example home, views in one to eight of its rooms), and a corridor: the
# home in windows. Some ten minutes on two cores, most of it rendering the homes. The chart needs gnuplot.
#   sh examples/scaling.sh [FOLDER for views and results, default out/scaling]
# Writes docs/scaling.svg and docs/results/scaling.jsonl.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
folder=${1:-$root/out/scaling}
program=${VDB_COMPLETE:-$root/build/release/vdb_complete}
results=$root/docs/results
mkdir -p "$folder"
folder=$(CDPATH='' cd -- "$folder" && pwd -P)

# The rooms of one example home share a frame: homes 8 to 15, 11 x 10 m. Their views as one folder.
home=$folder/home
[ -f "$folder/homes/15/transforms.json" ] ||
  "$root/build/release/make_rooms" homes --views 3 -o "$folder/homes"
mkdir -p "$home"
for room in 8 9 10 11 12 13 14 15; do ln -sfn "$folder/homes/$room" "$home/$room"; done
for part in head frames tail; do
  for room in 8 9 10 11 12 13 14 15; do
    awk -v part=$part -v room=$room '
      state == 1 && /^ \]/ { state = 2 }
      state == 0 && part == "head" && room == 8
      state == 1 && part == "frames" {
        sub("\"color/", "\"" room "/color/"); sub("\"depth/", "\"" room "/depth/"); if (room < 15 && /^  }$/) $0 = $0 ","; print }
      state == 2 && part == "tail" && room == 8
      /"frames": \[/ { state = 1 }' "$home/$room/transforms.json"
  done
done >"$folder/transforms.json"
mv "$folder/transforms.json" "$home/transforms.json"

# job KIND NUMBER VIEWS [OPTION...]: a line {"kind":...,"number":...,result}.
job() {
  kind=$1 number=$2 views=$3
  shift 3
  "$program" "$views" "$@" -o "$folder/$kind-$number.vdb" --json 2>>"$folder/log" |
    grep '"generated_tokens"' | sed "s/^{/{\"kind\":\"$kind\",\"number\":$number,/"
}
{
  for margin in .5 1 1.5 2 3 4 6 10; do job margin $margin "$root/examples/two_views" --margin $margin; done
  bounds="-1.5 -11.5 -0.5 12.5 1.5 3.2"
  last=2
  for rooms in 1 2 3 4 5 6 7 8; do
    # shellcheck disable=SC2086  # six numbers
    job rooms $rooms "$home" --frames 0-$last --bounds $bounds
    last=$((last + 3))
  done
} >"$folder/scaling.jsonl"
mv "$folder/scaling.jsonl" "$results/scaling.jsonl"

# columns KIND: number, seconds, peak in MB, generated tokens.
columns() {
  awk -v kind="$1" '
    function value(key) { return match($0, "\"" key "\":[0-9.e+-]+") ? substr($0, RSTART + length(key) + 3, RLENGTH - length(key) - 3) : 0 }
    index($0, "\"kind\":\"" kind "\"") { print value("number"), value("seconds"), value("peak_mb"), value("generated_tokens") }' "$results/scaling.jsonl"
}
columns margin >"$folder/margin"
columns rooms >"$folder/rooms"
cd "$folder"
gnuplot <<'PLOT'
set terminal svg size 900,380 font "sans,13" background "white"
set output "scaling.svg"
set multiplot layout 1,2
set grid; set key top left
set yrange [0:*]; set xrange [0:*]
set ylabel "seconds, views to files"; set y2label "generated tokens"; set y2tics; set ytics nomirror; set y2range [0:*]
set title "Two views, a growing volume"; set xlabel "margin around what was seen [m]"
plot "margin" using 1:2 with linespoints pt 7 title "seconds", "margin" using 1:4 axes x1y2 with linespoints pt 6 title "tokens"
set title "14 x 13 x 3.7 m, more of it seen"; set xlabel "rooms with three views each"
plot "rooms" using 1:2 with linespoints pt 7 title "seconds", "rooms" using 1:4 axes x1y2 with linespoints pt 6 title "tokens"
PLOT
mv scaling.svg "$results/../scaling.svg"
cat margin rooms
