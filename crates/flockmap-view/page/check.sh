#!/usr/bin/env bash
# Everything that must hold of the page of the live view, from a fresh clone: the committed bundle is what the sources make, types,
# tests of mirror, meshes and detail, and the page in Chromium against a made-up server and against two nodes. Prints what it measured.
#
# usage: page/check.sh [bundle | types | unit | browser | live]    (default: all)
# environment: FLOCKMAP=path of the program, else it is built; CHROMIUM=/usr/bin/chromium; SHOTS=folder for pictures; ONLY=part of the name of a browser test
# needs: node 20 or newer with npm; chromium, which is installed with apt-get where it is missing and that is allowed
set -euo pipefail
cd "$(dirname "$0")"
export CHROMIUM=${CHROMIUM:-/usr/bin/chromium}

type -P npm > /dev/null || { echo "missing: node 20 or newer, with npm" >&2; exit 1; }
npm ci --silent
export SKIP_INSTALL=1

bundle() {
    ./build.sh --check
    wc -c ../assets/* | sed 's/^/  /'
    echo "  view.js as gzip: $(gzip -9 -c ../assets/view.js | wc -c)"
}

types() { npx tsc; }

unit() {
    npx esbuild test/unit.mjs --bundle --platform=node --format=esm --log-level=warning --outfile=build/unit.mjs
    node --test build/unit.mjs
}

chromium() {
    if [ ! -x "$CHROMIUM" ]; then
        [ "$(id -u)" = 0 ] || { echo "missing: apt-get install chromium" >&2; exit 1; }
        apt-get update -qq && apt-get install -y -qq chromium > /dev/null
    fi
}

browser() {
    chromium
    node test/browser.mjs
}

# Two nodes and a radio for two minutes: the page has what the first node has, block by block.
live() {
    chromium
    if [ -z "${FLOCKMAP:-}" ]; then
        cargo build --release --locked -p flockmap-cli --manifest-path ../../../Cargo.toml
        FLOCKMAP=../../../target/release/flockmap
    fi
    FLOCKMAP=$(realpath "$FLOCKMAP") node test/live.mjs
}

step() {
    local start=$SECONDS
    echo "== page: $1"
    "$1"
    echo "== page: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in bundle types unit browser live; do step "$name"; done ;;
    bundle | types | unit | browser | live) step "$1" ;;
    *) sed -n '2,8p' "$0" >&2; exit 2 ;;
esac
