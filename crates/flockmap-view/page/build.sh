#!/usr/bin/env bash
# Builds the page into ../assets, whose files are committed and are part of the program.
#
# usage: page/build.sh [--check]    --check: builds into a temporary folder, fails if ../assets differs
set -euo pipefail
cd "$(dirname "$0")"
out=../assets
if [ "${1:-}" = --check ]; then
    out=$(mktemp -d)
    trap 'rm -rf "$out"' EXIT
elif [ $# -gt 0 ]; then
    sed -n '2,4p' "$0" >&2
    exit 2
fi
mkdir -p "$out"
type -P npm > /dev/null || { echo "missing: node 20 or newer, with npm" >&2; exit 1; }
[ -n "${SKIP_INSTALL:-}" ] || npm ci --silent
npx esbuild src/view.ts src/worker.ts --bundle --minify --format=iife --target=es2022 --charset=utf8 --legal-comments=eof \
    --log-level=warning --outdir="$out"
npx esbuild src/view.css --minify --target=es2022 --log-level=warning --outfile="$out/view.css"
cp src/index.html "$out/index.html"
if [ "${1:-}" = --check ]; then
    diff -r "$out" ../assets || { echo "assets differ from what page/build.sh makes of page/src" >&2; exit 1; }
    echo "assets are what page/build.sh makes"
fi
