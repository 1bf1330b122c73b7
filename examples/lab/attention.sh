#!/bin/sh
# The completer's attention, block-sparse and full (docs/notes/performance.md): a chunk of targets sees the nearest observed tokens;
# here more and fewer of both, up to all of a scene. Held-out rooms, two views in, one thread; some minutes on a quiet
# machine.
#   sh examples/lab/attention.sh [ROOMS, default 65-72]
# Writes docs/results/attention.md.
. "$(dirname -- "$0")/common.sh"
rooms=${1:-65-72}
scratch "$root/out/attention"

# judge NAME CONTEXT CHUNK: adds a line NAME=FILE to `judged`.
judged=
judge() {
  echo "$1" >&2
  "$lab" eval --scenes "rooms:$rooms" --views 2 --threads 1 --json --context-tokens "$2" --chunk-tokens "$3" \
    2>>"$folder/log" >"$folder/$2-$3.jsonl"
  judged="$judged$1=$folder/$2-$3.jsonl
"
}
judge '384, 160 (as trained)' 384 160
judge '96, 160' 96 160
judge '192, 160' 192 160
judge '384, 80' 384 80
judge '384, 320' 384 320
judge '384, 640' 384 640
judge '768, 160' 768 160
judge 'all, 160' 100000 160
judge 'all, all of a level' 100000 100000
{
  printf 'Rooms %s, two views, views to Gaussians (sh examples/lab/attention.sh). Rows: observed tokens seen, targets a chunk.\n' "$rooms"
  printf 'Differences: mean over rooms (standard error).\n\n'
  compare "$judged" --method completed --scores seconds peak_rss_mb f1 psnr leak
} >"$folder/table.md"
mv "$folder/table.md" "$results/attention.md"
cat "$results/attention.md"
