#!/usr/bin/env bash
# Builds libflockmap for aarch64 Linux on another machine, with its examples and tests; and runs them under an emulator where there
# is one. What it installs is in OUT: copy it to the robot.
#
# usage: scripts/aarch64.sh [OUT]        default: build-aarch64/installed
# environment: CARGO_TARGET_DIR, JOBS=2; RUN=1, 0: only build
# needs: rustup target add aarch64-unknown-linux-gnu; apt-get install g++-aarch64-linux-gnu, and qemu-user to run the tests
set -euo pipefail
cd "$(dirname "$0")/.."
OUT=${1:-build-aarch64/installed} JOBS=${JOBS:-2} RUN=${RUN:-1}
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target}
target=aarch64-unknown-linux-gnu cross=aarch64-linux-gnu
type -P $cross-g++ > /dev/null || { echo "missing: apt-get install g++-aarch64-linux-gnu" >&2; exit 1; }
[ -d "$(rustc --print sysroot)/lib/rustlib/$target" ] || { echo "missing: rustup target add $target" >&2; exit 1; }
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=$cross-gcc CC_aarch64_unknown_linux_gnu=$cross-gcc AR_aarch64_unknown_linux_gnu=$cross-ar
emulator=()
# The emulator finds the libraries of the other machine in the cross compiler's.
if [ "$RUN" = 1 ] && type -P qemu-aarch64 > /dev/null; then
    emulator=(-D "CMAKE_CROSSCOMPILING_EMULATOR=$(type -P qemu-aarch64);-L;/usr/$cross")
fi
cmake -S . -B build-aarch64 -G Ninja -D CMAKE_SYSTEM_NAME=Linux -D CMAKE_SYSTEM_PROCESSOR=aarch64 \
    -D CMAKE_C_COMPILER=$cross-gcc -D CMAKE_CXX_COMPILER=$cross-g++ -D FLOCKMAP_RUST_TARGET=$target \
    -D "FLOCKMAP_CARGO_TARGET_DIR=$CARGO_TARGET_DIR" -D "FLOCKMAP_CARGO_JOBS=$JOBS" -D CMAKE_DISABLE_FIND_PACKAGE_octomap=ON \
    "${emulator[@]}"
cmake --build build-aarch64 -j "$JOBS"
cmake --install build-aarch64 --prefix "$OUT" > /dev/null
echo "installed in $OUT:"
file -L "$OUT"/lib*/libflockmap.so 2> /dev/null || ls -l "$OUT"/lib*
if [ ${#emulator[@]} -gt 0 ]; then
    ctest --test-dir build-aarch64 --output-on-failure
else
    echo "left out: the tests, no emulator here (apt-get install qemu-user)"
fi
