#!/bin/sh
# Builds everything and runs all tests; arguments go to ctest (`-R SceneVdb`, say).
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
. "$root/examples/setup.sh"
install_packages
install_assets
build all
ctest --test-dir "$root/build/release" --output-on-failure -j "$(nproc)" "$@"
