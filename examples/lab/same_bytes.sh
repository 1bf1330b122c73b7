#!/bin/sh
# Shows that a change of the code changes no result: the files that the main job makes of the bundled views and, where a
# capture is given, of four of its frames, and the lines of `eval` on rooms 1 and 2, but for seconds and memory.
#   sh examples/lab/same_bytes.sh record FOLDER [CAPTURE]    what the build of today makes, as the reference
#   sh examples/lab/same_bytes.sh compare FOLDER [CAPTURE]   fails, and says what differs, unless it is the same
# THREADS (default 1) is the number of threads, CAPTURE a folder of views of which frames 0, 6, 12 and 18 are taken.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd -P)
task=${1:?record or compare} reference=${2:?folder of the reference} capture=${3:-}
program=${VDB_COMPLETE:-$root/build/release/vdb_complete} lab=${VDB_LAB:-$root/build/release/vdb_lab}
threads=${THREADS:-1}
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT

"$program" "$root/examples/two_views" -o "$made/two_views.vdb" --threads "$threads" >"$made/log"
[ -z "$capture" ] ||
  "$program" "$capture" --frames 0,6,12,18 -o "$made/capture.vdb" --threads "$threads" >"$made/log"
rm "$made/log"
(cd "$made" && sha256sum -- *) >"$made/files.sha256"
"$lab" eval --scenes rooms:1-2 --views 2 --threads "$threads" --json 2>/dev/null |
  sed -E 's/"(seconds|peak_rss_mb)":[^,}]*,?//g' >"$made/eval.jsonl"

mkdir -p "$reference"
case $task in
  record) cp "$made/files.sha256" "$made/eval.jsonl" "$reference" ;;
  compare)
    diff "$reference/files.sha256" "$made/files.sha256"
    diff "$reference/eval.jsonl" "$made/eval.jsonl"
    echo "the same"
    ;;
  *) echo "same_bytes: expected record or compare, found $task" >&2; exit 2 ;;
esac
