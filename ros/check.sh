#!/usr/bin/env bash
# Everything that must hold of flockmap-ros, from a fresh clone: format, lints, tests, and with Cyclone DDS from its Python wheel as the
# other side, in network namespaces: two robots on a recorded walk, and what goes wrong.
#
# usage: ros/check.sh [fmt | clippy | test | robots | faults]    (default: all)
# environment: FLOCKMAP, the program (default: built here); CARGO_TARGET_DIR (default: ros/target); FLOCKMAP_DATA, recordings (default:
#   ../shared/data beside the repository); JOBS=2; RATE=1, how fast the walk is played
# needs: root for namespaces, ip, g++, python3-venv, liboctomap-dev
set -euo pipefail
cd "$(dirname "$0")"
root=$(cd .. && pwd)
export CARGO_TERM_COLOR=never CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
JOBS=${JOBS:-2} FLOCKMAP_DATA=${FLOCKMAP_DATA:-$root/../shared/data}
export FLOCKMAP_DATA

fmt() { cargo fmt --check; }
clippy() { cargo clippy --release --all-targets --locked -j "$JOBS" -- -D warnings; }
tests() { cargo test --release --locked -j "$JOBS"; }

programs() {
    if [ -z "${FLOCKMAP:-}" ]; then
        cargo build --release --locked -j "$JOBS" -p flockmap-cli --manifest-path "$root/Cargo.toml"
        FLOCKMAP=$CARGO_TARGET_DIR/release/flockmap
    fi
    cargo build --release --locked -j "$JOBS"
    ros=$CARGO_TARGET_DIR/release/flockmap-ros
}

robots() {
    programs
    local code=0
    scripts/two_robots.sh "$FLOCKMAP" "$ros" || code=$?
    # 2: no recordings, and it has said so.
    [ "$code" = 0 ] || [ "$code" = 2 ]
}

faults() {
    programs
    scripts/faults.sh "$ros"
}

step() {
    local start=$SECONDS
    echo "== ros: $1"
    "$1"
    echo "== ros: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy tests robots faults; do step "$name"; done ;;
    test) step tests ;;
    fmt | clippy | robots | faults) step "$1" ;;
    *) sed -n '2,10p' "$0" >&2; exit 2 ;;
esac
