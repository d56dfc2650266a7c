#!/usr/bin/env bash
# Two nodes play a record each, over a radio that loses 20 %. Three mirrors follow the first: one as fast as it can, one
# that reads 100,000 bytes a second over TCP, and one that is killed and started again. At the end each must equal the
# node's map, voxel by voxel. Then hostile readers: garbage, one that never reads, a thousand connections; an honest
# mirror must still get the map.
#
# usage: scripts/mirrors.sh RECORD1 RECORD2
# environment: FLOCKMAP, the program (default: built here, release); SPEED=4, of the records; RESOLUTION=0.2, RANGE=30;
#   MIRRORS=1, 0: nobody reads, to compare the processor time; ORIGINS=1, 0: the fast one does not ask who saw each
#   voxel; HOSTILE=1; RATE=100000; OUT, folder for what is left (default: a new one)
# exit: 0 all equal, 1 not.
set -euo pipefail

SPEED=${SPEED:-4} MIRRORS=${MIRRORS:-1} ORIGINS=${ORIGINS:-1} HOSTILE=${HOSTILE:-1}
RESOLUTION=${RESOLUTION:-0.2} RANGE=${RANGE:-30} RATE=${RATE:-100000}
[ $# = 2 ] || { sed -n '2,11p' "$0" >&2; exit 2; }
records=("$(realpath "$1")" "$(realpath "$2")")
cd "$(dirname "$0")/.."
if [ -z "${FLOCKMAP:-}" ]; then
    cargo build --release --locked -p flockmap-cli
    FLOCKMAP=${CARGO_TARGET_DIR:-target}/release/flockmap
fi
OUT=${OUT:-$(mktemp -d)}
mkdir -p "$OUT"
rm -f "$OUT"/*.log
port=$((20000 + $$ % 120 * 100))
pids=()
trap 'for pid in "${pids[@]}"; do kill -9 "$pid" 2> /dev/null || true; done' EXIT

for n in 1 2; do
    output=
    [ $n = 2 ] || output="[map_output]
listen_unix = \"map.sock\"
listen_tcp = \"127.0.0.1:$((port + 80))\""
    cat > "$OUT/$n.toml" << END
id = $n
[map]
resolution_m = $RESOLUTION
range_m = $RANGE
[state]
path = "state"
[network]
bind = "127.0.0.1:$((port + 50 + n))"
peers = ["127.0.0.1:$((port + 3 - n))"]
[sensor]
record = "${records[n - 1]}"
speed = $SPEED
$output
[metrics]
status_period_s = 5
[output]
save_map_at_end = "$n.ply"
save_free = true
report_json = "$n.json"
end_when_quiet_s = 12
END
done
"$FLOCKMAP" radio "127.0.0.1:$((port + 51))" "127.0.0.1:$((port + 52))" --listen "127.0.0.1:$port" --loss 0.2 > "$OUT/radio.log" 2>&1 < /dev/null &
radio=$!
pids+=($radio)
"$FLOCKMAP" node --config "$OUT/1.toml" 2> "$OUT/1.log" &
node=$!
"$FLOCKMAP" node --config "$OUT/2.toml" 2> "$OUT/2.log" &
pids+=($node $!)
until grep -q "gives the map out" "$OUT/1.log"; do sleep 0.05; done

follow() {
    local name=$1
    shift
    "$FLOCKMAP" mirror "$@" --out "$OUT/$name.ply" --free > "$OUT/$name.txt" 2> "$OUT/$name.log" &
    pids+=($!)
}
names=()
if [ "$MIRRORS" = 1 ]; then
    names=(fast slow back)
    origins=--origins
    [ "$ORIGINS" = 1 ] || origins=
    # shellcheck disable=SC2086
    follow fast "unix:$OUT/map.sock" $origins
    follow slow "127.0.0.1:$((port + 80))" --rate-max "$RATE"
    follow back "unix:$OUT/map.sock"
    back=${pids[-1]}
fi
# Processor time in ticks and the most memory, until the node has ended; a reader is killed meanwhile and comes back.
ticks=0 most=0 begun=$SECONDS was_killed=0
while stat=$(cat "/proc/$node/stat" 2> /dev/null) && [ "$(cut -d' ' -f3 <<< "$stat")" != Z ]; do
    ticks=$(awk '{print $14 + $15}' <<< "$stat")
    now=$(awk "/VmHWM/ {print \$2}" "/proc/$node/status" 2> /dev/null || true)
    most=${now:-$most}
    if [ "$MIRRORS" = 1 ] && [ $was_killed = 0 ] && [ $((SECONDS - begun)) -ge 8 ]; then
        was_killed=1
        kill -9 "$back"
        sleep 1
        follow back "unix:$OUT/map.sock"
    fi
    sleep 0.2
done
wait "${pids[@]:1}" 2> /dev/null || true
kill "$radio" 2> /dev/null || true
echo "node 1: processor time $(awk "BEGIN {print $ticks / $(getconf CLK_TCK)}") s, most memory $most kB, mirrors: ${names[*]:-none}"
result=0
for name in "${names[@]}"; do
    sed "s/^/$name: /" "$OUT/$name.txt"
    if cmp -s "$OUT/1.ply" "$OUT/$name.ply"; then
        echo "$name: equals the node's map"
    else
        echo "$name: DIFFERS from the node's map"
        result=1
    fi
done
if [ "$MIRRORS" = 0 ] || [ "$HOSTILE" = 0 ]; then
    echo "left in $OUT"
    exit $result
fi

# Hostile readers of a node that plays the record again.
sed -i 's/end_when_quiet_s = 12/end_when_quiet_s = 3/; s/"1\.ply"/"hostile.ply"/' "$OUT/1.toml"
"$FLOCKMAP" node --config "$OUT/1.toml" 2> "$OUT/hostile.log" &
node=$!
pids+=($node)
until grep -q "gives the map out" "$OUT/hostile.log"; do sleep 0.05; done
follow honest "unix:$OUT/map.sock"
sleep 2
echo "hostile: most memory before $(awk '/VmHWM/ {print $2}' "/proc/$node/status") kB"
ulimit -n 4096
(head -c 1000000 /dev/urandom > "/dev/tcp/127.0.0.1/$((port + 80))") 2> /dev/null || true
exec {deaf}<> "/dev/tcp/127.0.0.1/$((port + 80))"
printf '\x1f\0\0\0\x01FLKM\x01\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0' >&"$deaf"
for _ in $(seq 1000); do
    exec {held}<> "/dev/tcp/127.0.0.1/$((port + 80))" || break
done 2> /dev/null
sleep 3
echo "hostile: most memory after garbage, one that never reads and 1,000 connections $(awk '/VmHWM/ {print $2}' "/proc/$node/status") kB"
while kill -0 "$node" 2> /dev/null && [ "$(cut -d' ' -f3 "/proc/$node/stat" 2> /dev/null)" != Z ]; do
    now=$(awk "/VmHWM/ {print \$2}" "/proc/$node/status" 2> /dev/null || true)
    most=${now:-$most}
    sleep 0.2
done
wait "${pids[-1]}" 2> /dev/null || true
echo "hostile: most memory at the end $most kB"
grep -E "warning: a reader|more warnings" "$OUT/hostile.log" | sed 's/^/hostile: /' || true
if cmp -s "$OUT/hostile.ply" "$OUT/honest.ply"; then
    echo "honest: equals the node's map"
else
    echo "honest: DIFFERS from the node's map"
    result=1
fi
echo "left in $OUT"
exit $result
