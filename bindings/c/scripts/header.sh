#!/usr/bin/env bash
# Makes include/flockmap.h anew. With --check: fails if the committed one differs.
# environment: CBINDGEN, the program (default: the one in PATH). It must be 0.29.4, since others write other headers.
set -euo pipefail
cd "$(dirname "$0")/.."
CBINDGEN=${CBINDGEN:-cbindgen}
version=$("$CBINDGEN" --version 2> /dev/null || true)
if [ "$version" != "cbindgen 0.29.4" ]; then
    echo "cbindgen 0.29.4 is needed, found \"$version\": cargo install cbindgen --version 0.29.4 --locked" >&2
    exit 1
fi
made=$(mktemp)
trap 'rm -f "$made"' EXIT
"$CBINDGEN" --quiet --config cbindgen.toml --crate flockmap-c --output "$made" .
# The first word of results is that of the library: FLOCKMAP_OK, not FLOCKMAP_RESULT_OK.
sed -i 's/FLOCKMAP_RESULT_/FLOCKMAP_/g' "$made"
if [ "${1:-}" = --check ]; then
    diff -u include/flockmap.h "$made" || { echo "include/flockmap.h is not what src/ makes: run bindings/c/scripts/header.sh" >&2; exit 1; }
else
    cp "$made" include/flockmap.h
fi
