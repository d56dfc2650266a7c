#!/bin/sh
# Four robots on the loopback on a bad radio (15 % loss, some doubled, some damaged), flying the same rounds over and over. After
# the first rounds the map is whole, so memory has to be flat from then on: the mean of VmRSS over the last third of the time may be
# at most 5 % and 1 MiB above that of the middle third, for every robot. At the end all four must hold equal layers.
#
# usage: scripts/soak.sh [MINUTES]        default 30; at least 3
# environment: FLOCKMAP, the program (default: built here, release); ROUND_S=30, length of a round; LOSS=0.15; OUT, folder for records,
#   logs and samples (default: a new one, removed if all is well)
# exit: 0 flat and equal, 1 not.
set -eu

minutes=${1:-30}
ROUND_S=${ROUND_S:-30} LOSS=${LOSS:-0.15}
cd "$(dirname "$0")/.."
if [ "$minutes" -lt 3 ]; then
    echo "$minutes minutes are too few: the first third has to cover the world" >&2
    exit 1
fi
if [ -z "${FLOCKMAP:-}" ]; then
    cargo build --release --locked -p flockmap-cli
    FLOCKMAP=${CARGO_TARGET_DIR:-target}/release/flockmap
fi
temporary=
if [ -z "${OUT:-}" ]; then
    OUT=$(mktemp -d)
    temporary=$OUT
fi
mkdir -p "$OUT"
robots="1 2 3 4"
pids=
cleanup() {
    for pid in $pids; do kill -9 "$pid" 2> /dev/null || true; done
}
trap cleanup EXIT
trap 'exit 1' INT TERM

"$FLOCKMAP" sim fly --scene indoor --robots 4 --seconds "$ROUND_S" --lidar mid360 --range-noise 0.02 --moving-obstacles 4 \
    --resolution 0.2 --no-view --out "$OUT" > "$OUT/fly.log"
rounds=$(((minutes * 60 + ROUND_S - 1) / ROUND_S))
port=$((20000 + $$ % 120 * 100))
addresses=
for n in $robots; do
    peers=
    for other in $robots; do
        [ "$other" = "$n" ] || peers="$peers\"127.0.0.1:$((port + other))\", "
    done
    # What grows up to a limit has to reach it in the first third: a small store, and few snapshots.
    cat > "$OUT/$n.toml" << END
id = $n
[map]
resolution_m = 0.2
range_m = 7.0
[session]
store_mb = 1
[state]
path = "state"
[network]
bind = "127.0.0.1:$((port + 50 + n))"
peers = [$peers]
[sensor]
record = "robot$n.mcap"
repeat = $rounds
[metrics]
status_period_s = 10.0
[output]
report_json = "$n.json"
end_when_quiet_s = 15.0
END
    addresses="$addresses 127.0.0.1:$((port + 50 + n))"
done
# shellcheck disable=SC2086 # words
"$FLOCKMAP" radio $addresses --listen "127.0.0.1:$port" --loss "$LOSS" --delay-ms 20 --jitter-ms 10 --duplication 0.01 \
    --bit-flips 0.002 --json "$OUT/radio.json" < /dev/null > "$OUT/radio.log" 2>&1 &
radio=$!
pids=$radio
for n in $robots; do
    "$FLOCKMAP" node --config "$OUT/$n.toml" > /dev/null 2> "$OUT/$n.log" &
    eval "pid_$n=$!"
    pids="$pids $!"
    : > "$OUT/$n.rss"
done

echo "four robots fly $rounds rounds of $ROUND_S s on a radio that loses $LOSS"
began=$(date +%s)
length=$((rounds * ROUND_S))
while [ $(($(date +%s) - began)) -lt "$length" ]; do
    second=$(($(date +%s) - began))
    for n in $robots; do
        eval "pid=\$pid_$n"
        rss=$(awk '/^VmRSS/ { print $2 }' "/proc/$pid/status" 2> /dev/null || true)
        if [ -z "$rss" ]; then
            echo "robot $n is gone after $second s:"
            tail -5 "$OUT/$n.log"
            exit 1
        fi
        echo "$second $rss" >> "$OUT/$n.rss"
    done
    sleep 1
done
for n in $robots; do
    eval "wait \$pid_$n" || {
        echo "robot $n failed:"
        tail -20 "$OUT/$n.log"
        exit 1
    }
done
kill -TERM "$radio"
wait "$radio" || true
sed -n '/robot  /,$p' "$OUT/radio.log"

result=0
for n in $robots; do
    sed -n 's/^      "\(origin\|epoch\|missing\|voxels\|digest\)": *\([^,]*\),\{0,1\}$/\1 \2/p' "$OUT/$n.json" > "$OUT/$n.layers"
    if ! diff "$OUT/1.layers" "$OUT/$n.layers"; then
        echo "robots 1 and $n differ"
        result=1
    fi
    if grep -q panicked "$OUT/$n.log"; then
        echo "robot $n panicked:"
        grep panicked "$OUT/$n.log"
        result=1
    fi
done
streams=$(grep -c '^digest' "$OUT/1.layers" || true)
if [ "$streams" != 4 ] || grep -q '^missing [^0]' "$OUT/1.layers"; then
    echo "expected 4 streams of which nothing is missing, found:"
    cat "$OUT/1.layers"
    result=1
fi
[ $result = 1 ] || echo "equal layers of $streams streams, nothing missing"
echo "mean VmRSS in KiB:    first third  middle third   last third    change"
for n in $robots; do
    awk -v n="$n" -v length_s="$length" '
        { third = int(3 * $1 / length_s); sum[third] += $2; count[third] += 1 }
        END {
            for (t = 0; t < 3; t++) if (count[t] == 0) { print "robot " n ": no samples"; exit 1 }
            for (t = 0; t < 3; t++) mean[t] = sum[t] / count[t]
            change = mean[2] - mean[1]
            printf "  robot %d          %12.0f  %12.0f %12.0f  %+7.0f (%+.1f %%)\n", n, mean[0], mean[1], mean[2], change,
                100 * change / mean[1]
            if (change > 0.05 * mean[1] + 1024) { print "robot " n ": memory grows"; exit 1 }
        }' "$OUT/$n.rss" || result=1
done
if [ $result = 0 ]; then
    [ -z "$temporary" ] || rm -rf "$temporary"
    echo "flat"
else
    echo "what was recorded is in $OUT"
fi
exit $result
