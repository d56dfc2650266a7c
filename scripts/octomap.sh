#!/bin/sh
# A robot that maps with OctoMap feeds a node with the states of its voxels, first the keys that changed, then boxes; a
# second node without a sensor hears it through a radio that loses a third. At the end both must hold what OctoMap's own
# tree holds, voxel by voxel.
#
# usage: scripts/octomap.sh [RECORD]      default: a generated forest
# needs g++ and OctoMap (Debian: apt install liboctomap-dev)
# environment: FLOCKMAP, the program, and MESSAGES, the example `record_messages` (default: both built here, release);
#   RESOLUTION=0.1, RANGE=7 (metres); LOSS=0.33; OUT, folder for records, maps and logs (default: a new one, removed if
#   all is well)
# exit: 0 equal, 1 not.
set -eu

RESOLUTION=${RESOLUTION:-0.1} RANGE=${RANGE:-7} LOSS=${LOSS:-0.33}
record=${1:-}
[ -z "$record" ] || record=$(realpath "$record")
cd "$(dirname "$0")/.."
if [ ! -e /usr/include/octomap/octomap.h ]; then
    echo "OctoMap is not installed: apt install liboctomap-dev" >&2
    exit 1
fi
if [ -z "${FLOCKMAP:-}" ] || [ -z "${MESSAGES:-}" ]; then
    cargo build --release --locked -p flockmap-cli
    cargo build --release --locked -p flockmap-node --example record_messages
    FLOCKMAP=${CARGO_TARGET_DIR:-target}/release/flockmap
    MESSAGES=${CARGO_TARGET_DIR:-target}/release/examples/record_messages
fi
temporary=
if [ -z "${OUT:-}" ]; then
    OUT=$(mktemp -d)
    temporary=$OUT
fi
mkdir -p "$OUT"
pids=
cleanup() {
    for pid in $pids; do kill -9 "$pid" 2> /dev/null || true; done
}
trap cleanup EXIT
trap 'exit 1' INT TERM

g++ -O2 -std=c++17 -Wall -Wextra crates/flockmap-node/examples/octomap/octomap_feed.cpp -loctomap -loctomath \
    -o "$OUT/octomap_feed"
if [ -z "$record" ]; then
    "$FLOCKMAP" sim fly --scene forest --robots 1 --seconds 20 --no-view --out "$OUT" > "$OUT/fly.log"
    record=$OUT/robot1.mcap
fi
"$MESSAGES" "$record" > "$OUT/scans.bin"

# Waits up to a minute until a log has a line.
wait_for() {
    tries=0
    until grep -q "$2" "$1"; do
        tries=$((tries + 1))
        if [ "$tries" -gt 600 ]; then
            echo "no line with \"$2\" in $1:" >&2
            tail -5 "$1" >&2
            exit 1
        fi
        sleep 0.1
    done
}

port=$((20000 + $$ % 120 * 100))
for how in keys box; do
    run=$OUT/$how
    mkdir -p "$run"
    port=$((port + 10))
    for n in 1 2; do
        cat > "$run/$n.toml" << END
id = $n
[map]
resolution_m = $RESOLUTION
range_m = $RANGE
[session]
relay = "never"
[state]
path = "state"
[network]
bind = "127.0.0.1:$((port + 4 + n))"
peers = ["127.0.0.1:$((port + 3 - n))"]
[output]
save_map_at_end = "$n.bt"
report_json = "$n.json"
linger_ms = 60000
END
    done
    printf '[sensor]\nlisten_tcp = "127.0.0.1:%s"\n' "$port" >> "$run/1.toml"
    "$FLOCKMAP" radio "127.0.0.1:$((port + 5))" "127.0.0.1:$((port + 6))" --listen "127.0.0.1:$port" --loss "$LOSS" \
        --delay-ms 20 < /dev/null > "$run/radio.log" 2>&1 &
    radio=$!
    pids="$pids $radio"
    for n in 1 2; do
        "$FLOCKMAP" node --config "$run/$n.toml" > /dev/null 2> "$run/$n.log" &
        eval "node_$n=$!"
        pids="$pids $!"
    done
    wait_for "$run/1.log" "hears"
    wait_for "$run/2.log" "hears"
    "$OUT/octomap_feed" feed "$OUT/scans.bin" "$port" "$how" "$RESOLUTION" "$RANGE" "$run/octomap.bt"
    # All that was sent has been read before the connection is said to have ended.
    wait_for "$run/1.log" "sensor connection 1 ended after"
    # The first node ends when the other has confirmed all that it sent.
    # shellcheck disable=SC2154 # set by eval
    for pid in "$node_1" "$node_2"; do
        kill -TERM "$pid"
        wait "$pid" || true
    done
    kill -TERM "$radio"
    wait "$radio" || true
    pids=
    "$OUT/octomap_feed" check "$run/octomap.bt" "$run/1.bt" "$run/2.bt" || {
        echo "fed by $how, the maps differ; see $run" >&2
        temporary=
        exit 1
    }
done
[ -z "$temporary" ] || rm -r "$temporary"
