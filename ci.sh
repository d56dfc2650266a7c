#!/usr/bin/env bash
# Everything that must hold before a change lands. Run it here as CI does: ./ci.sh
# One step alone: ./ci.sh fmt | clippy | docs | test | faketime | readme | tables | seeds
# Beside it, for what has heavy tool chains, before a change to that lands: ./ci.sh heavy
set -euo pipefail
cd "$(dirname "$0")"
export CARGO_TERM_COLOR=never

# The fuzzer has a workspace of its own. It is not built here: all but its five lines is in a test of flockmap-codec.
fmt() {
    cargo fmt --all --check
    cargo fmt --check --manifest-path fuzz/Cargo.toml
}
clippy() { cargo clippy --workspace --all-targets --locked -- -D warnings; }
docs() { RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --locked; }
# The second of the README's two commands.
tests() { cargo test --locked; }

# A program whose clock shows 1970 at each start. Where Debian's `faketime` is not installed this is left out; what it tests is tested within one process too.
faketime() {
    if ! type -P faketime > /dev/null; then
        echo "left out: no faketime here (apt-get install faketime)"
        return
    fi
    # Without -p: the features of the whole workspace, for which all is built already.
    cargo test --locked --test starts -- --ignored --nocapture two_starts_of_a_program
}

# The first of the README's two commands, as a newcomer runs it.
readme() {
    local out
    out=$(mktemp -d)
    cargo run --release --locked -- demo --out "$out"
    test -s "$out/report.html" -a -s "$out/report.json"
    rm -r "$out"
}

# What a protocol change costs shows as a difference of a table.
tables() { cargo run --release --locked -- sim table --robots-max 20 --file tests/tables/swarms.txt --check; }

# Swarms with a checker at every event (docs/swarm.md): those that failed once, fixed ones, and ones that nobody has flown before, which follow
# from the commit.
seeds() {
    local base swarm="cargo run --release --locked -- sim swarm"
    base=$((16#$(git rev-parse HEAD | cut -c 1-10) * 1000))
    echo "== fresh seeds from $base on"
    $swarm --file tests/seeds/once-failed.txt
    $swarm --seed 1 --seeds 3000
    $swarm --seed "$base" --seeds 4000
    $swarm --robots 12 --radio mesh_line --seed $((base + 10000)) --seeds 100
    $swarm --robots 10 --budget 600 --cast broadcast --seed $((base + 20000)) --seeds 30
    $swarm --robots 8 --radio intermittent --seconds 30 --seed $((base + 30000)) --seeds 40
    $swarm --robots 3 --seconds 300 --seed $((base + 40000)) --seeds 12
}

# The bindings, flockmap-ros, flockmap-foxglove and flockmap-zenoh are workspaces of their own and bring their own tools.
heavy() {
    local check
    cargo build --release --locked -p flockmap-cli
    # All of them test this program, and none builds it again.
    FLOCKMAP=$(realpath "${CARGO_TARGET_DIR:-target}/release/flockmap")
    export FLOCKMAP
    for check in crates/flockmap-view/page/check.sh bindings/*/check.sh ros/check.sh foxglove/check.sh zenoh/check.sh; do
        "$check"
    done
    local data=${FLOCKMAP_DATA:-../shared/data}/hku_mb
    if [ -f "$data/robot1.mcap" ]; then
        scripts/flight.sh "$data/robot1.mcap" "$data/robot2.mcap"
    else
        echo "left out: scripts/flight.sh, no recordings in $data"
    fi
}

step() {
    local start=$SECONDS
    echo "== $1"
    "$1"
    echo "== $1: $((SECONDS - start)) s"
}

case "${1:-all}" in
    all) for name in fmt clippy docs readme tables seeds tests faketime; do step "$name"; done ;;
    test) step tests ;;
    fmt | clippy | docs | faketime | readme | tables | seeds | heavy) step "$1" ;;
    *) sed -n '2,4p' "$0" >&2; exit 2 ;;
esac
