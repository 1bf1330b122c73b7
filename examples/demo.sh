#!/bin/sh
# Completes a room seen in two views: installs what is missing, builds, runs. Results in out/.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
. "$root/examples/setup.sh"
install_packages
build vdb_complete
mkdir -p "$root/out"
"$root/build/release/vdb_complete" "$root/examples/two_views" -o "$root/out/demo.vdb"
echo "Results:"
ls -l "$root/out/"demo*
