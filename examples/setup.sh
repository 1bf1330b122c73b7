# Sourced by examples/demo.sh and tests/run.sh, which set `root` to the repository's root.
# install_packages, then build TARGET...: quick when there is nothing to do. install_assets where rooms are made.
: "${root:?}"

as_root() {
  if [ "$(id -u)" = 0 ]; then
    "$@"
  elif command -v sudo >/dev/null; then
    sudo "$@"
  else
    echo "setup: must be root, or have sudo, to run: $*" >&2
    return 1
  fi
}

# Installs what the given lists, or else .ci/packages, name and is not there (Debian).
install_packages() {
  [ $# -gt 0 ] || set -- "$root/.ci/packages"
  if ! command -v dpkg-query >/dev/null; then
    echo "setup: not a Debian system: expecting what $* names to be there" >&2
    return 0
  fi
  wanted=$(cat "$@")
  # shellcheck disable=SC2016,SC2086  # dpkg-query's own variables; one word per package
  there=$(dpkg-query -W -f '${db:Status-Abbrev}${Package}\n' $wanted 2>/dev/null | sed -n 's/^ii *//p')
  missing=
  for package in $wanted; do
    case "
$there
" in
      *"
$package
"*) ;;
      *) missing="$missing $package" ;;
    esac
  done
  if [ -n "$missing" ]; then
    echo "setup: installing$missing" >&2
    as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq >&2
    # shellcheck disable=SC2086
    as_root env DEBIAN_FRONTEND=noninteractive \
      apt-get install -y -qq --no-install-recommends $missing >&2
  fi
  use_openblas
}

# The furniture that rooms are made of (Debian, 137 MB to load): sweethome3d-furniture, and the jar out of
# sweethome3d without the Java that the package asks for.
install_assets() {
  assets=/usr/local/share/sweethome3d
  if [ ! -d /usr/share/sweethome3d/furniture ]; then
    echo "setup: installing sweethome3d-furniture" >&2
    as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq >&2
    as_root env DEBIAN_FRONTEND=noninteractive \
      apt-get install -y -qq --no-install-recommends sweethome3d-furniture >&2
  fi
  if [ ! -e /usr/share/sweethome3d/sweethome3d.jar ] && [ ! -e "$assets/sweethome3d.jar" ]; then
    echo "setup: putting sweethome3d.jar into $assets" >&2
    folder=$(mktemp -d)
    (cd "$folder" && apt-get download -qq sweethome3d >&2 && dpkg -x sweethome3d_*.deb .)
    as_root install -D -m 644 "$folder/usr/share/sweethome3d/sweethome3d.jar" "$assets/sweethome3d.jar"
    rm -rf "$folder"
  fi
}

# libtorch calls whatever libblas.so.3 is: OpenBLAS is 20 to 60 times faster than the reference one.
use_openblas() {
  triplet=$(uname -m)-linux-gnu
  link=/etc/alternatives/libblas.so.3-$triplet
  wanted_blas=/usr/lib/$triplet/openblas-openmp/libblas.so.3
  if [ -e "$wanted_blas" ] && [ "$(readlink "$link")" != "$wanted_blas" ]; then
    echo "setup: making OpenBLAS the libblas.so.3 of this system" >&2
    as_root update-alternatives --set "libblas.so.3-$triplet" "$wanted_blas" >&2 ||
      echo "setup: could not; the networks will run slowly" >&2
  fi
}

# build TARGET...: configures build/release where that is still to do, and builds.
build() {
  cache=$root/build/release/CMakeCache.txt
  # A build folder that came with a moved or copied checkout is of no use to CMake.
  if [ -f "$cache" ] && ! grep -qxF "CMAKE_HOME_DIRECTORY:INTERNAL=$root" "$cache"; then
    rm -rf "$root/build/release"
  fi
  if [ ! -f "$root/build/release/build.ninja" ]; then
    (cd "$root" && cmake --preset release) >&2
  fi
  cmake --build "$root/build/release" --target "$@" >&2
}
