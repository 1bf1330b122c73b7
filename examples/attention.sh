#!/bin/sh
# The completer's attention, block-sparse and full (docs/performance.md): a chunk of targets sees the nearest observed tokens;
# here more and fewer of both, up to all of a scene. Held-out rooms, two views in, one thread; some minutes on a quiet
# machine.
#   sh examples/attention.sh [ROOMS, default 65-72]
# Writes docs/results/attention.md.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
rooms=${1:-65-72}
program=${VDB_LAB:-$root/build/release/vdb_lab}
mkdir -p "$root/out"

row() {
  "$program" eval --scenes "rooms:$rooms" --views 2 --threads 1 --json --context-tokens "$1" --chunk-tokens "$2" 2>>"$root/out/attention.log" |
    grep '"scene":"mean"' | grep '"method":"completed"' | grep -v '"reliability"' | awk -v context="$3" -v chunk="$4" '
      function value(key) { return match($0, "\"" key "\":[0-9.e+-]+") ? substr($0, RSTART + length(key) + 3, RLENGTH - length(key) - 3) : 0 }
      { printf "| %s | %s | %.2f | %.0f | %.3f | %.2f | %.3f |\n", context, chunk, value("seconds"), value("peak_rss_mb"), value("f1"), value("psnr"), value("leak") }'
}
all=100000
{
  printf 'Rooms %s, two views, views to Gaussians (sh examples/attention.sh).\n\n' "$rooms"
  echo '| observed tokens seen | targets a chunk | s | peak MB | F1 | PSNR | leak |'
  echo '|---|---|---|---|---|---|---|'
  row 96 160 96 160
  row 192 160 192 160
  row 384 80 384 80
  row 384 160 '**384**' '**160**'
  row 384 320 384 320
  row 384 640 384 640
  row 768 160 768 160
  row $all 160 all 160
  row $all $all all 'all of a level'
} >"$root/out/attention.md"
mv "$root/out/attention.md" "$root/docs/results/attention.md"
cat "$root/docs/results/attention.md"
