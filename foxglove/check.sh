#!/usr/bin/env bash
# Everything that must hold of flockmap-foxglove, from a fresh clone: format, lints, tests, and two nodes whose map a
# WebSocket client of another author takes and compares with what the node saves.
#
# usage: foxglove/check.sh [fmt | clippy | test | live]    (default: all)
# environment: FLOCKMAP, the program (default: built here); CARGO_TARGET_DIR (default: foxglove/target); JOBS=2;
#   RECORDS="FILE FILE", what the robots see (default: a flight in a simulated forest); SPEED=1, of the records;
#   VENV, where the Python tools are or are to be put (default: in CARGO_TARGET_DIR)
# needs: python3-venv
set -euo pipefail
cd "$(dirname "$0")"
root=$(cd .. && pwd)
export CARGO_TERM_COLOR=never CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
JOBS=${JOBS:-2}

fmt() { cargo fmt --check; }
clippy() { cargo clippy --release --all-targets --locked -j "$JOBS" -- -D warnings; }
tests() { cargo test --release --locked -j "$JOBS"; }

live() {
    if [ -z "${FLOCKMAP:-}" ]; then
        cargo build --release --locked -j "$JOBS" -p flockmap-cli --manifest-path "$root/Cargo.toml"
        FLOCKMAP=$CARGO_TARGET_DIR/release/flockmap
    fi
    cargo build --release --locked -j "$JOBS"
    local venv=${VENV:-$CARGO_TARGET_DIR/venv} out
    if ! cmp -s tests/requirements.txt "$venv/installed.txt"; then
        python3 -m venv "$venv"
        "$venv/bin/pip" install -q --disable-pip-version-check -r tests/requirements.txt
        cp tests/requirements.txt "$venv/installed.txt"
    fi
    out=$(mktemp -d)
    local records
    read -r -a records <<< "${RECORDS:-}"
    if [ ${#records[@]} = 0 ]; then
        "$FLOCKMAP" sim fly --scene forest --robots 2 --seconds 30 --out "$out/flight" > "$out/sim.log" 2>&1
        records=("$out/flight/robot1.mcap" "$out/flight/robot2.mcap")
    fi
    if ! "$venv/bin/python" tests/live.py "$FLOCKMAP" "$CARGO_TARGET_DIR/release/flockmap-foxglove" "${records[@]}" "$out"; then
        echo "left in $out" >&2
        return 1
    fi
    rm -r "$out"
}

step() {
    local start=$SECONDS
    echo "== foxglove: $1"
    "$1"
    echo "== foxglove: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy tests live; do step "$name"; done ;;
    test) step tests ;;
    fmt | clippy | live) step "$1" ;;
    *) sed -n '2,10p' "$0" >&2; exit 2 ;;
esac
