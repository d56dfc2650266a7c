#!/usr/bin/env bash
# Everything that must hold of the page of the view, from a fresh clone: the committed assets, types, tests of what the worker does, and the
# page in Chromium without a graphics card against a made-up server. With FLOCKMAP also against two real nodes, for two minutes.
#
# usage: page/check.sh [assets | types | unit | browser | live]    (default: all)
# environment: FLOCKMAP, the program, for `live`; CHROMIUM=/usr/bin/chromium; SHOTS, folder for pictures; LIVE_SECONDS=120
# needs: node 20 or newer with npm; Debian's chromium, which is installed where it is missing and this is root
set -euo pipefail
cd "$(dirname "$0")"
export CHROMIUM=${CHROMIUM:-/usr/bin/chromium}

type -P npm > /dev/null || { echo "missing: node 20 or newer, with npm" >&2; exit 1; }

assets() { SKIP_INSTALL=1 ./build.sh --check; }
types() { npx tsc --noEmit; }

unit() {
    mkdir -p build
    npx esbuild test/unit.mjs --bundle --platform=node --format=esm --target=node20 --log-level=warning --outfile=build/unit.mjs
    node --test build/unit.mjs
}

chromium() {
    [ -x "$CHROMIUM" ] && return
    if [ "$(id -u)" = 0 ] && type -P apt-get > /dev/null; then
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium > /dev/null
    fi
    [ -x "$CHROMIUM" ] || { echo "missing: apt-get install chromium (or CHROMIUM)" >&2; exit 1; }
}

browser() {
    chromium
    node test/browser.mjs
}

live() {
    if [ -z "${FLOCKMAP:-}" ]; then
        echo "left out: FLOCKMAP does not say where the program is"
        return
    fi
    chromium
    FLOCKMAP=$(realpath "$FLOCKMAP")
    export FLOCKMAP
    node test/players.mjs
    node test/live.mjs
}

step() {
    local start=$SECONDS
    echo "== page: $1"
    "$1"
    echo "== page: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all | assets | types | unit | browser | live) npm ci --silent ;;
    *) sed -n '2,9p' "$0" >&2; exit 2 ;;
esac
case "${1:-all}" in
    all) for name in assets types unit browser live; do step "$name"; done ;;
    *) step "$1" ;;
esac
