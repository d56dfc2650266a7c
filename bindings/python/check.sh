#!/usr/bin/env bash
# Everything that must hold of the Python bindings, from a fresh clone: format, lints, the wheel in fresh environments, stubs, tests,
# examples, and what Python costs beside Rust. What it installs and writes is in bindings/python/build.
#
# usage: bindings/python/check.sh [fmt | clippy | wheel | test | examples | bench]    (default: all)
# environment: PYTHONS, programs to test with (default: python3, and each further python3.10 to python3.14 that runs here);
#   FLOCKMAP, the program (default: built here, release); FLOCKMAP_DATA, recordings (default: ../shared/data beside the repository)
set -euo pipefail
cd "$(dirname "$0")"
export CARGO_TERM_COLOR=never PIP_DISABLE_PIP_VERSION_CHECK=1
build=$PWD/build
target=${CARGO_TARGET_DIR:-$PWD/target}
tools="maturin==1.16.0 mypy==2.4.1 pytest matplotlib numpy"

# A Python with its own environment: $1 the program, $2 the name.
environment() {
    if ! "$1" -m venv "$build/$2" > "$build/venv.log" 2>&1; then
        echo "no virtual environment for $1: apt-get install python3-venv python3-dev" >&2
        cat "$build/venv.log" >&2
        return 1
    fi
}

# Those that run here, one of each version.
pythons() {
    local seen="" python version
    for python in ${PYTHONS:-python3 python3.10 python3.11 python3.12 python3.13 python3.14}; do
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2> /dev/null) || continue
        case $version in 2.* | 3.[0-9]) continue ;; esac
        [[ " $seen " == *" $version "* ]] || echo "$python $version"
        seen="$seen $version"
    done
}

fmt() { cargo fmt --check; }
# As a module of Python it is linked without libpython, here as in the wheel.
clippy() { PYO3_BUILD_EXTENSION_MODULE=1 cargo clippy --release --locked --all-targets -- -D warnings; }

wheel() {
    rm -rf "$build"
    mkdir -p "$build"
    environment python3 tools
    # shellcheck disable=SC2086
    "$build/tools/bin/pip" install -q $tools
    "$build/tools/bin/maturin" build --release --locked --out "$build" --interpreter "$build/tools/bin/python"
    ls -l "$build"/*.whl
}

test() {
    local python version
    if [ -z "${FLOCKMAP:-}" ]; then
        (cd ../.. && cargo build --release --locked -p flockmap-cli)
        FLOCKMAP=${CARGO_TARGET_DIR:-$(cd ../.. && pwd)/target}/release/flockmap
    fi
    export FLOCKMAP
    while read -r python version; do
        echo "-- Python $version"
        environment "$python" "$version"
        # shellcheck disable=SC2086
        "$build/$version/bin/pip" install -q --force-reinstall "$build"/*.whl pytest mypy matplotlib
        # With names that nobody can take for the sources.
        (cd "$build" && "$version/bin/python" -m mypy.stubtest flockmap._flockmap)
        "$build/$version/bin/python" -m mypy
        "$build/$version/bin/python" -m pytest -rs tests
    done < <(pythons)
}

examples() {
    local data python version
    read -r python version < <(pythons)
    mkdir -p "$build/pictures"
    python=$build/$version/bin/python
    "$python" examples/two_over_udp.py "$build/pictures/two_over_udp.png"
    "$python" examples/planner.py "$build/pictures/planner.png"
    data=${FLOCKMAP_DATA:-../../../shared/data}/hku_mb
    if [ -f "$data/robot1.mcap" ]; then
        "$python" examples/bag_bytes.py "$data/robot1.mcap" "$data/robot2.mcap" --seconds 30 --out "$build/pictures/bag_bytes.png"
    else
        echo "left out: bag_bytes.py, no recordings in $data"
    fi
}

bench() {
    local python version
    read -r python version < <(pythons)
    PYO3_BUILD_EXTENSION_MODULE=1 cargo build --release --locked --example beside_rust
    # Times of a busy machine: a second time, if the first one was disturbed.
    "$build/$version/bin/python" bench/beside_rust.py "$target/release/examples/beside_rust" \
        || "$build/$version/bin/python" bench/beside_rust.py "$target/release/examples/beside_rust" 51
}

step() {
    local start=$SECONDS
    echo "== python: $1"
    "$1"
    echo "== python: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy wheel test examples bench; do step "$name"; done ;;
    fmt | clippy | wheel | test | examples | bench) step "$1" ;;
    *) sed -n '2,7p' "$0" >&2; exit 2 ;;
esac
