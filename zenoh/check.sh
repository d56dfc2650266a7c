#!/usr/bin/env bash
# Everything that must hold of flockmap-zenoh, from a fresh clone: format, lints, tests, and swarms in network namespaces, with
# the router and the client of Zenoh's Python wheel as strangers.
#
# usage: zenoh/check.sh [fmt | clippy | test | fleet [NAME...]]    (default: all; NAME: flight, kills, access, garbage, liar, joined, swarms,
#   disk; and size, by ROBOTS, PACKAGES, STATIONS and CONFIG, which takes long)
# environment: FLOCKMAP, the program (default: built here); CARGO_TARGET_DIR (default: zenoh/target); JOBS=2;
#   OUT, where logs and reports of `fleet` are left (default: a new folder, removed if all is well);
#   VENV, where the Python tools are or are to be put (default: in CARGO_TARGET_DIR)
# needs: python3-venv, openssl, iproute2; root, for the namespaces. Where there are none, `fleet` is left out
set -euo pipefail
cd "$(dirname "$0")"
root=$(cd .. && pwd)
export CARGO_TERM_COLOR=never CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
JOBS=${JOBS:-2}

fmt() { cargo fmt --check; }
clippy() { cargo clippy --release --all-targets --locked -j "$JOBS" -- -D warnings; }
tests() { cargo test --release --locked -j "$JOBS"; }

fleet() {
    if ! ip netns add "flockmap-probe-$$" 2> /dev/null; then
        echo "left out: network namespaces are not allowed here (ip netns needs root)"
        return
    fi
    ip netns del "flockmap-probe-$$"
    if [ -z "${FLOCKMAP:-}" ]; then
        cargo build --release --locked -j "$JOBS" -p flockmap-cli --manifest-path "$root/Cargo.toml"
        FLOCKMAP=$CARGO_TARGET_DIR/release/flockmap
    fi
    cargo build --release --locked -j "$JOBS" --bins --example many
    local venv=${VENV:-$CARGO_TARGET_DIR/venv} out=${OUT:-}
    if ! cmp -s tests/requirements.txt "$venv/installed.txt"; then
        python3 -m venv "$venv"
        "$venv/bin/pip" install -q --disable-pip-version-check -r tests/requirements.txt
        cp tests/requirements.txt "$venv/installed.txt"
    fi
    [ -n "$out" ] || out=$(mktemp -d)
    if ! "$venv/bin/python" tests/fleet.py "$FLOCKMAP" "$CARGO_TARGET_DIR/release/flockmap-zenoh" "$out" "$@"; then
        echo "left in $out" >&2
        return 1
    fi
    [ -n "${OUT:-}" ] || rm -r "$out"
}

step() {
    local start=$SECONDS name=$1
    echo "== zenoh: $name"
    "$@"
    echo "== zenoh: $name: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy tests fleet; do step "$name"; done ;;
    test) step tests ;;
    fmt | clippy) step "$1" ;;
    fleet) step "$@" ;;
    *) sed -n '2,11p' "$0" >&2; exit 2 ;;
esac
