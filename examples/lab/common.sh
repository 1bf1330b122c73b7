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

# compare LINES [OPTION...]: vdb_lab's, of lines NAME=FILE.
compare() (
  lines=$1
  shift
  IFS='
'
  # shellcheck disable=SC2086  # one word a line
  "$lab" compare $lines "$@"
)
