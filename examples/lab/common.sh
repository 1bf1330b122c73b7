# Sourced by the studies beside it: the repository's root, the programs, and where results are kept.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd -P)
program=${VDB_COMPLETE:-$root/build/release/vdb_complete}
lab=${VDB_LAB:-$root/build/release/vdb_lab}
results=$root/docs/results

# scratch FOLDER: made, and in `folder` as an absolute path.
scratch() {
  mkdir -p "$1"
  folder=$(CDPATH='' cd -- "$1" && pwd -P)
}

# finished LOG STEPS: whether a training came to its last step.
finished() { [ -f "$1" ] && [ "$(tail -n 1 "$1" | cut -d, -f1)" = "$2" ]; }

# evaluate FILE OPTION...: the lines of vdb_lab eval, on one thread, unless FILE is there already.
evaluate() {
  lines=$1
  shift
  if [ -s "$lines" ]; then return; fi
  echo "$lines" >&2
  "$lab" eval "$@" --threads 1 --json 2>>"$folder/eval.log" >"$folder/draft-$$.jsonl"
  mv "$folder/draft-$$.jsonl" "$lines"
}

# compare LINES [OPTION...]: vdb_lab's, of lines NAME=FILE.
compare() (
  lines=$1
  shift
  IFS='
'
  # shellcheck disable=SC2086  # one word a line
  "$lab" compare $lines "$@"
)
