#!/usr/bin/env bash
# The format on other machines: the codec's golden files, its corpus and its round trips on x86-64 in debug and release, and under qemu
# on aarch64 and on s390x, whose numbers are big-endian. All must pass and print the same digests of what was written and read.
#
# Not a part of ci.sh: it needs some 400 MB of Debian's packages, and a standard library built for each machine takes minutes. On Debian 12:
#   apt-get install --no-install-recommends rustc-web cargo-web rust-web-src qemu-user-static \
#       gcc-aarch64-linux-gnu libc6-dev-arm64-cross gcc-s390x-linux-gnu libc6-dev-s390x-cross
#
# ./scripts/other-machines.sh [x86-64 | aarch64 | s390x] ...
set -euo pipefail
cd "$(dirname "$0")/.."
export CARGO_TERM_COLOR=never
out=$(mktemp -d)
trap 'rm -r "$out"' EXIT

# Tests of flockmap-codec: quick under emulation.
tests=(--test golden --test fuzz_corpus)

# The digests go to a file of the machine.
note() {
    tee >(cat >&2) | grep -o 'digest of .*' | sort >"$out/$1"
}

native() {
    cargo test --locked -p flockmap-codec "${tests[@]}" "${@:2}" -- --nocapture | note "$1"
}

# Debian's compiler brings its own sources of the standard library, which are built for the machine.
emulated() {
    local machine=$1 upper=${1^^}
    env "CARGO_TARGET_${upper}_UNKNOWN_LINUX_GNU_LINKER=$machine-linux-gnu-gcc" \
        "CARGO_TARGET_${upper}_UNKNOWN_LINUX_GNU_RUNNER=qemu-$machine-static -L /usr/$machine-linux-gnu" \
        RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 \
        /usr/bin/cargo test -Zbuild-std --target "$machine-unknown-linux-gnu" --locked -p flockmap-codec \
        "${tests[@]}" -- --nocapture | note "$machine"
}

for machine in "${@:-all}"; do
    case $machine in
        all) native debug; native release --release; emulated aarch64; emulated s390x ;;
        x86-64) native debug; native release --release ;;
        aarch64 | s390x) emulated "$machine" ;;
        *) sed -n '9p' "$0" >&2; exit 2 ;;
    esac
done
echo "== digests"
(cd "$out" && grep . -- *)
test -z "$(cd "$out" && cat -- * | sort -u | cut -d: -f1 | uniq -d)" || { echo "they differ"; exit 1; }
