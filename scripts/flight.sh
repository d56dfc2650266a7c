#!/usr/bin/env bash
# Two nodes play a record each, over a radio that loses 20 %; the first one records its flight (docs/flights.md). The file
# is decoded with Foxglove's readers and SDK, opened in Rerun without a window, and replayed. Then a node is killed, and
# one has a disk that is full: what was written must be readable, and the robot must fly on.
#
# usage: scripts/flight.sh RECORD1 RECORD2
# environment: FLOCKMAP, the program (default: built here, release); SPEED=4, of the records; RESOLUTION=0.2, RANGE=30;
#   OUT, folder for what is left (default: a new one); VENV, where the Python tools are or are to be put (default: in OUT)
# needs: python3-venv; for the pictures xvfb, mesa-vulkan-drivers, libxkbcommon-x11-0. Where Xvfb is not there they are left out
# exit: 0 all as it should be, 1 not.
set -euo pipefail

SPEED=${SPEED:-4} RESOLUTION=${RESOLUTION:-0.2} RANGE=${RANGE:-30}
[ $# = 2 ] || { sed -n '2,11p' "$0" >&2; exit 2; }
records=("$(realpath "$1")" "$(realpath "$2")")
cd "$(dirname "$0")/.."
if [ -z "${FLOCKMAP:-}" ]; then
    cargo build --release --locked -p flockmap-cli
    FLOCKMAP=${CARGO_TARGET_DIR:-$PWD/target}/release/flockmap
fi
OUT=$(realpath "${OUT:-$(mktemp -d)}")
mkdir -p "$OUT"
rm -f "$OUT"/*.mcap "$OUT"/*.log
VENV=${VENV:-$OUT/venv}
if [ ! -x "$VENV/bin/rerun" ]; then
    python3 -m venv "$VENV"
    "$VENV/bin/pip" install -q rerun-sdk==0.41.0 foxglove-sdk==0.30.3 mcap==1.6.0 mcap-protobuf-support==0.6.0 mcap-ros2-support==0.6.0 numpy
fi
port=$((20000 + $$ % 120 * 100))
pids=()
trap 'for pid in "${pids[@]}"; do kill -9 "$pid" 2> /dev/null || true; done' EXIT
result=0
fault() {
    echo "FAULT: $1"
    result=1
}

# A configuration: $1 its name, $2 the number of the robot, $3 what is recorded.
configuration() {
    cat > "$OUT/$1.toml" << END
id = $2
[map]
resolution_m = $RESOLUTION
range_m = $RANGE
[state]
path = "state"
[network]
bind = "127.0.0.1:$((port + 50 + $2))"
peers = ["127.0.0.1:$((port + 3 - $2))"]
[sensor]
record = "${records[$2 - 1]}"
speed = $SPEED
$3
[metrics]
status_period_s = 5
[output]
save_map_at_end = "$1.ply"
report_json = "$1.json"
end_when_quiet_s = 5
END
}
recorded() { printf '[record]\npath = "%s.mcap"\n%s\n' "$1" "$2"; }

"$FLOCKMAP" radio "127.0.0.1:$((port + 51))" "127.0.0.1:$((port + 52))" --listen "127.0.0.1:$port" --loss 0.2 > "$OUT/radio.log" 2>&1 < /dev/null &
radio=$!
pids+=($radio)
configuration plain 1 "$(recorded plain "")"
configuration all 1 "$(recorded all $'scans = true\norigins = true')"
configuration other 2 ""

# Flies both: $1 the configuration of the first one.
fly() {
    "$FLOCKMAP" node --config "$OUT/other.toml" 2> "$OUT/other.log" &
    local other=$!
    pids+=($other)
    "$FLOCKMAP" node --config "$OUT/$1.toml" 2> "$OUT/$1.log" || fault "$1: the node ended badly"
    wait $other || true
}
# Draws what Rerun shows of a file from its last picture on.
draw() {
    if ! type -P Xvfb > /dev/null; then
        echo "left out: no Xvfb here (apt-get install xvfb mesa-vulkan-drivers libxkbcommon-x11-0)"
        return
    fi
    local last
    last=$("$VENV/bin/python" - "$OUT/$1.mcap" << 'END'
import sys
from mcap.reader import make_reader
messages = make_reader(open(sys.argv[1], "rb")).iter_messages()
print(max(message.log_time for _, channel, message in messages if channel.topic.endswith("/viewer/map")))
END
)
    "$VENV/bin/rerun" analytics disable > /dev/null 2>&1 || true
    "$VENV/bin/rerun" mcap convert "$OUT/$1.mcap" -o "$OUT/$1.rrd" --start-time "$last" > "$OUT/$1.rerun.log" 2>&1
    LIBGL_ALWAYS_SOFTWARE=1 timeout 120 xvfb-run -a -s "-screen 0 1600x1000x24" "$VENV/bin/rerun" --port auto \
        --window-size 1600x1000 --screenshot-to "$OUT/$1.png" "$OUT/$1.rrd" >> "$OUT/$1.rerun.log" 2>&1 || true
    [ -s "$OUT/$1.png" ] && echo "picture: $OUT/$1.png" || fault "$1: no picture of Rerun"
}

for name in plain all; do
    echo "-- $name"
    fly "$name"
    "$VENV/bin/python" scripts/flight.py "$OUT/$name.mcap" robot1 || fault "$name: Foxglove's tools find faults"
    "$VENV/bin/rerun" mcap check "$OUT/$name.mcap" 2> /dev/null | grep -E "^(ok|warn|error|bad)" || fault "$name: Rerun finds faults"
    draw "$name"
done

echo "-- replayed"
frames_of() { "$FLOCKMAP" info "$1" | grep "frames of" || true; }
echo "recorded:$(frames_of "$OUT/all.mcap"); played:$(frames_of "${records[0]}")"
[ "$(frames_of "$OUT/all.mcap")" = "$(frames_of "${records[0]}")" ] || fault "the record of the flight has other scans than the record it played"
# Once more without a name: the old flight stays.
before=$(sha256sum < "$OUT/plain.mcap")
configuration again 1 "$(recorded plain "")"
fly again
[ "$before" = "$(sha256sum < "$OUT/plain.mcap")" ] && [ -s "$OUT/plain-2.mcap" ] || fault "the old flight is not what it was"
echo "a second flight is in plain-2.mcap, and the first one is what it was"

echo "-- killed"
configuration killed 1 "$(recorded killed "")"
"$FLOCKMAP" node --config "$OUT/killed.toml" 2> "$OUT/killed.log" &
killed=$!
pids+=($killed)
sleep 12
kill -9 $killed
wait $killed 2> /dev/null || true
"$VENV/bin/python" - "$OUT/killed.mcap" << 'END' || fault "a killed flight cannot be read"
import sys
from mcap.exceptions import EndOfFile
from mcap.stream_reader import StreamReader
times = []
try:
    for record in StreamReader(open(sys.argv[1], "rb")).records:
        if hasattr(record, "log_time"):
            times.append(record.log_time)
except EndOfFile:
    pass
seconds = (max(times) - min(times)) / 1e9
print(f"killed after 12 s: {len(times)} messages of {seconds:.1f} s are there")
sys.exit(seconds < 9)
END
"$VENV/bin/rerun" mcap convert "$OUT/killed.mcap" -o "$OUT/killed.rrd" --recover > /dev/null 2>&1 || fault "Rerun cannot recover a killed flight"

echo "-- disk full"
configuration full 1 "$(recorded full "")"
# A write beyond a megabyte fails, as on a disk without room.
(
    trap '' XFSZ
    ulimit -f 1000
    exec "$FLOCKMAP" node --config "$OUT/full.toml" 2> "$OUT/full.log"
) || true
sed -n "/error: the record/s#$OUT/##gp" "$OUT/full.log"
[ "$(grep -c "error: the record" "$OUT/full.log")" = 1 ] || fault "a full disk is not told once"
"$VENV/bin/python" - "$OUT/full.json" << 'END' || fault "with a full disk the robot does not fly on"
import json, sys
node = json.load(open(sys.argv[1]))["counters"]["node"]
print({key: node[key] for key in ("frames", "record_bytes", "record_stopped")})
sys.exit(not (node["record_stopped"] == 1 and node["frames"] > 100))
END

kill $radio 2> /dev/null || true
echo "left in $OUT"
exit $result
