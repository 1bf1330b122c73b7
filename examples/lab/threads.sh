#!/bin/sh
# Time of the main job with one thread and with the default, alone and beside two busy loops:
#   sh examples/lab/threads.sh PROGRAM VIEWS [OPTIONS of the main job]
# Runs alternate, so that both meet the same machine; the medians of 5 are compared. Only a machine
# with nothing else to do shows what "alone" means. Fails where the default is less than 1.5 x faster
# than one thread alone, or takes more than 1.5 x its time beside the loops.
set -eu
program=$1
shift
folder=$(mktemp -d)
loops=
trap 'kill $loops 2>/dev/null || true; rm -rf "$folder"' EXIT

seconds() {  # of the main job with these options
  begin=$(date +%s.%N)
  "$program" "$@" -o "$folder/out.vdb" >/dev/null 2>&1
  date +%s.%N | awk -v begin="$begin" '{ print $1 - begin }'
}

compare() {  # NAME, then options: medians in $one and $many
  name=$1
  shift
  for run in 1 2 3 4 5; do
    seconds "$@" --threads 1 >>"$folder/$name.one"
    seconds "$@" >>"$folder/$name.many"
  done
  one=$(sort -n "$folder/$name.one" | sed -n 3p)
  many=$(sort -n "$folder/$name.many" | sed -n 3p)
  echo "$name: --threads 1 $one s, default $many s, ratio $(awk "BEGIN { print $many / $one }")"
}

failed=0
compare alone "$@"
awk "BEGIN { exit !($one >= 1.5 * $many) }" || failed=1
for loop in 1 2; do
  sh -c 'while :; do :; done' &
  loops="$loops $!"
done
compare busy "$@"
awk "BEGIN { exit !($many <= 1.5 * $one) }" || failed=1
exit $failed
