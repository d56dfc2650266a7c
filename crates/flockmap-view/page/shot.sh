#!/usr/bin/env bash
# Takes the picture with which the README begins: a replay in a browser, coloured by the robot that saw a voxel last.
#
# usage: page/shot.sh PICTURE.jpg [FLOCKMAP ARGUMENT...]    (default: replay forest --loss 0.2)
# environment: FLOCKMAP=path of the program (default: the release build); CHROMIUM=/usr/bin/chromium
# needs: node 20 or newer with npm; chromium
set -euo pipefail
out=$(realpath "${1:?usage: page/shot.sh PICTURE.jpg [FLOCKMAP ARGUMENT...]}")
shift
cd "$(dirname "$0")"
program=${FLOCKMAP:-../../../target/release/flockmap}
[ $# -gt 0 ] || set -- replay forest --loss 0.2
[ -d node_modules ] || npm ci --silent
log=$(mktemp)
"$program" "$@" --view=127.0.0.1:0 > /dev/null 2> "$log" &
running=$!
trap 'kill -INT $running 2> /dev/null || true; wait $running 2> /dev/null || true; rm -f "$log"' EXIT
until url=$(grep -o -m 1 'http://[^ ]*' "$log"); do
    kill -0 $running 2> /dev/null || { cat "$log" >&2; exit 1; }
    sleep 0.2
done
until grep -q "until Ctrl-C" "$log"; do sleep 0.5; done
CHROMIUM=${CHROMIUM:-/usr/bin/chromium} node shot.mjs "$url" "$out"
