#!/usr/bin/env bash
# Two nodes play a record each, over a radio that loses 20 %; a C++ mirror follows the first until it ends. Then its map must
# equal the one that the node saved, voxel by voxel.
#
# usage: scripts/mirror.sh MIRROR_CHECK RECORD1 RECORD2
# environment: FLOCKMAP, the program; SPEED=4, of the records; RESOLUTION=0.2, RANGE=30; ORIGINS=0, 1: ask who saw each
#   voxel; SECONDS_MAX=0: the nodes end after so long; 0: when the records have ended
# exit: 0 equal, 1 not.
set -euo pipefail
[ $# = 3 ] || { sed -n '2,9p' "$0" >&2; exit 2; }
FLOCKMAP=${FLOCKMAP:?the program flockmap}
SPEED=${SPEED:-4} RESOLUTION=${RESOLUTION:-0.2} RANGE=${RANGE:-30} ORIGINS=${ORIGINS:-0} SECONDS_MAX=${SECONDS_MAX:-0}
check=$(realpath "$1") records=("$(realpath "$2")" "$(realpath "$3")")
OUT=$(mktemp -d)
pids=()
trap 'for pid in "${pids[@]}"; do kill "$pid" 2> /dev/null || true; done; rm -rf "$OUT"' EXIT

# Ports of this process alone, as far as one can know: the nodes must be told of the radio, and it of them, before any starts.
base=$((20000 + $$ % 120 * 100))
end="end_when_quiet_s = 12"
[ "$SECONDS_MAX" = 0 ] || end="end_after_s = $SECONDS_MAX"
for n in 1 2; do
    output=
    [ $n = 2 ] || output=$'[map_output]\nlisten_unix = "map.sock"'
    cat > "$OUT/$n.toml" << END
id = $n
[map]
resolution_m = $RESOLUTION
range_m = $RANGE
[state]
path = "state"
[network]
bind = "127.0.0.1:$((base + 50 + n))"
peers = ["127.0.0.1:$((base + 3 - n))"]
[sensor]
record = "${records[n - 1]}"
speed = $SPEED
$output
[output]
save_map_at_end = "$n.ply"
save_free = true
$end
END
done
"$FLOCKMAP" radio "127.0.0.1:$((base + 51))" "127.0.0.1:$((base + 52))" --listen "127.0.0.1:$base" --loss 0.2 > "$OUT/radio.log" 2>&1 < /dev/null &
radio=$!
pids+=($radio)
for n in 1 2; do
    "$FLOCKMAP" node --config "$OUT/$n.toml" > "$OUT/$n.json" 2> "$OUT/$n.log" &
    pids+=($!)
done
for _ in $(seq 600); do
    grep -q "gives the map out" "$OUT/1.log" && break
    kill -0 "${pids[1]}" 2> /dev/null || { cat "$OUT/1.log" >&2; exit 1; }
    sleep 0.1
done
arguments=("unix:$OUT/map.sock" "$OUT/1.ply")
[ "$ORIGINS" = 0 ] || arguments+=(--origins)
result=0
"$check" "${arguments[@]}" || result=$?
for n in 1 2; do wait "${pids[n]}" || { cat "$OUT/$n.log" >&2; result=1; }; done
kill "$radio" 2> /dev/null || true
[ $result = 0 ] && echo "the C++ mirror equals the node's map"
exit $result
