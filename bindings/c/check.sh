#!/usr/bin/env bash
# Everything that must hold of the C and C++ bindings, from a fresh clone: format, lints, tests of the ABI, the header, and for
# each of no, the address and the undefined-behaviour sanitizer: cmake, ctest. Then an installed package, and two nodes.
#
# usage: bindings/c/check.sh [fmt | clippy | test | header | cmake | install | nodes | fuzz]
# environment: FLOCKMAP, the program (default: built here); CARGO_TARGET_DIR (default: bindings/c/target);
#   FLOCKMAP_DATA=../shared/data beside the repository, for `nodes`; JOBS=2; FUZZ_SECONDS=60, for `fuzz`, which is not
#   part of all
set -euo pipefail
cd "$(dirname "$0")"
here=$PWD root=$(cd ../.. && pwd)
export CARGO_TERM_COLOR=never CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$here/target}
JOBS=${JOBS:-2} FLOCKMAP_DATA=${FLOCKMAP_DATA:-$root/../shared/data}
build=$CARGO_TARGET_DIR/cmake
sanitizers=(none address undefined)

missing=()
for tool in cmake:cmake ninja:ninja-build g++:g++ gcc:gcc pkg-config:pkg-config; do
    type -P "${tool%%:*}" > /dev/null || missing+=("${tool##*:}")
done
if [ ${#missing[@]} -gt 0 ]; then
    echo "missing: apt-get install ${missing[*]} (and, for one more example, liboctomap-dev)" >&2
    exit 1
fi

fmt() { cargo fmt --check && cargo fmt --check --manifest-path fuzz/Cargo.toml; }
clippy() { cargo clippy --release --all-targets --locked -j "$JOBS" -- -D warnings; }
tests() { cargo test --release --locked -j "$JOBS"; }

header() {
    local tools=$CARGO_TARGET_DIR/tools
    if [ -z "${CBINDGEN:-}" ]; then
        [ -x "$tools/bin/cbindgen" ] || cargo install cbindgen --version 0.29.4 --locked -j "$JOBS" --root "$tools"
        export CBINDGEN=$tools/bin/cbindgen
    fi
    scripts/header.sh --check
}

program() {
    if [ -z "${FLOCKMAP:-}" ]; then
        cargo build --release --locked -j "$JOBS" -p flockmap-cli --manifest-path "$root/Cargo.toml"
        FLOCKMAP=$CARGO_TARGET_DIR/release/flockmap
    fi
}

cmake_all() {
    program
    local sanitizer flag
    for sanitizer in "${sanitizers[@]}"; do
        flag=$sanitizer
        [ "$flag" != none ] || flag=
        cmake -S . -B "$build/$sanitizer" -G Ninja -D "FLOCKMAP_SANITIZE=$flag" -D "FLOCKMAP_CARGO_TARGET_DIR=$CARGO_TARGET_DIR" \
            -D "FLOCKMAP_CARGO_JOBS=$JOBS" -D "FLOCKMAP_PROGRAM=$FLOCKMAP" -D CMAKE_COMPILE_WARNING_AS_ERROR=ON
        cmake --build "$build/$sanitizer" -j "$JOBS"
        echo "== ctest, sanitizer: $sanitizer"
        ctest --test-dir "$build/$sanitizer" --output-on-failure
    done
}

# What users have: find_package with both libraries, and pkg-config.
install_all() {
    local prefix=$build/installed user=$build/user
    rm -rf "$prefix" "$user"
    cmake --install "$build/none" --prefix "$prefix" > /dev/null
    cmake -S tests/package -B "$user" -G Ninja -D "CMAKE_PREFIX_PATH=$prefix"
    cmake --build "$user" -j "$JOBS"
    ctest --test-dir "$user" --output-on-failure
    local lib
    lib=$(dirname "$(find "$prefix" -name flockmap.pc)")
    # shellcheck disable=SC2046
    PKG_CONFIG_PATH=$lib gcc -std=c99 -Wall -Wextra -Werror -pedantic examples/first_map.c -o "$user/by_pkg_config" \
        $(PKG_CONFIG_PATH=$lib pkg-config --define-variable=prefix="$prefix" --cflags --libs flockmap)
    LD_LIBRARY_PATH=$lib/.. "$user/by_pkg_config"
}

nodes() {
    program
    local records=("$FLOCKMAP_DATA"/hku_mb/robot{1,2}.mcap)
    if [ ! -f "${records[0]}" ]; then
        echo "left out: no ${records[0]} (FLOCKMAP_DATA says where the recordings are)"
        return
    fi
    FLOCKMAP=$FLOCKMAP scripts/mirror.sh "$build/none/tests/mirror_check" "${records[@]}"
    FLOCKMAP=$FLOCKMAP ORIGINS=1 scripts/mirror.sh "$build/none/tests/mirror_check" "${records[@]}"
}

fuzz() {
    type -P cargo-fuzz > /dev/null || { echo "missing: cargo install cargo-fuzz" >&2; exit 1; }
    RUSTC_BOOTSTRAP=1 cargo fuzz run -s none --fuzz-dir fuzz --target-dir "$CARGO_TARGET_DIR/fuzz" calls -- \
        -max_total_time="${FUZZ_SECONDS:-60}" -max_len=4096 -rss_limit_mb=2048 -timeout=20 -print_final_stats=1
}

step() {
    local start=$SECONDS
    echo "== c: $1"
    "$1"
    echo "== c: $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy tests header cmake_all install_all nodes; do step "$name"; done ;;
    test) step tests ;;
    cmake) step cmake_all ;;
    install) step install_all ;;
    fmt | clippy | header | nodes | fuzz) step "$1" ;;
    *) sed -n '2,9p' "$0" >&2; exit 2 ;;
esac
