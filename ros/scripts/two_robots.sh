#!/usr/bin/env bash
# Two robots with flockmap-ros play the recorded walk hku_mb. Each has a network namespace: its ROS topics, carried by Cyclone DDS on
# the other side, stay on its own loopback, and the node speaks to the other one through `flockmap radio` at 20 % loss. Then: every
# cloud was mapped; each output that was received, also by a late subscriber, equals the map; the own layers equal what `flockmap
# export` maps of the record and received ones their origin's; fused maps, processor time, memory and latencies are told.
#
# usage: two_robots.sh FLOCKMAP FLOCKMAP_ROS [DIR]
#   logs, messages and maps go to DIR (default: a new one, removed if all is well). Needs root, ip, g++, liboctomap-dev.
# environment, with defaults: LOSS=0.2 DELAY_MS=20 RATE=1 (of the records) PLAY_S=1000 RESOLUTION=0.2 RANGE=30 SETTLE_S=8;
#   FLOCKMAP_DATA, PYTHON: see environment.sh
# exit: 0 all equal, 1 not, 2 no data.
set -euo pipefail

[ $# -ge 2 ] || { sed -n '2,13p' "$0" >&2; exit 1; }
flockmap=$(realpath "$1") flockmap_ros=$(realpath "$2") dir=${3:-}
LOSS=${LOSS:-0.2} DELAY_MS=${DELAY_MS:-20} RATE=${RATE:-1} PLAY_S=${PLAY_S:-1000} RESOLUTION=${RESOLUTION:-0.2} RANGE=${RANGE:-30}
SETTLE_S=${SETTLE_S:-8}
. "$(dirname "$0")/environment.sh"
records=$FLOCKMAP_DATA/hku_mb
if [ ! -e "$records/robot1.mcap" ]; then
    echo "skipped: no data in $records"
    exit 2
fi
temporary=
[ -n "$dir" ] || dir=$(mktemp -d) temporary=$dir
mkdir -p "$dir"
dir=$(realpath "$dir")
name=rosmap$$
pids=()
cleanup() {
    for pid in "${pids[@]}"; do kill -9 "$pid" 2> /dev/null || true; done
    for n in 0 1 2; do ip netns del "$name-$n" 2> /dev/null || true; done
}
trap cleanup EXIT
trap 'exit 1' INT TERM

ip netns add "$name-0"
ip -n "$name-0" link set lo up
ip -n "$name-0" link add bridge type bridge
ip -n "$name-0" addr add 10.77.0.100/24 dev bridge
ip -n "$name-0" link set bridge up
for n in 1 2; do
    ip netns add "$name-$n"
    ip -n "$name-$n" link add radio type veth peer name "robot$n" netns "$name-0"
    ip -n "$name-0" link set "robot$n" master bridge up
    ip -n "$name-$n" addr add "10.77.0.$n/24" dev radio
    ip -n "$name-$n" link set lo up
    # Off by default, and then who is there already hears of a newcomer seconds later.
    ip -n "$name-$n" link set lo multicast on
    ip -n "$name-$n" link set radio up
done
within() { local n=$1; shift; exec ip netns exec "$name-$n" "$@"; }
start() { # NAMESPACE LOG COMMAND...; its pid is in $started
    local n=$1 log=$2
    shift 2
    (within "$n" "$@") > "$log" 2>&1 < /dev/null &
    started=$!
    pids+=("$started")
}

# Robots 1 and 2, and two that only listen to the radio at the end: 3 holds the layer of 1 alone, 4 that of 2.
declare -A address=([1]=10.77.0.1:7700 [2]=10.77.0.2:7700 [3]=10.77.0.100:7703 [4]=10.77.0.100:7704)
configuration() { # ROBOT PEERS MUTED
    local peers=
    for other in $2; do peers="$peers\"10.77.0.100:$((7800 + other))\", "; done
    cat > "$dir/$1.toml" << END
id = $1
name = "robot$1"
[map]
resolution_m = $RESOLUTION
range_m = $RANGE
[fusion]
muted = [$3]
[state]
path = "state"
[network]
bind = "${address[$1]}"
peers = [$peers]
[output]
save_map_at_end = "$1.bt"
report_json = "$1.json"
linger_ms = 3000
END
}
configuration 1 2 ""
configuration 2 1 ""
configuration 3 "1 2" 2
configuration 4 "1 2" 1
echo 'end_when_quiet_s = 30' | tee -a "$dir/3.toml" >> "$dir/4.toml"
start 0 "$dir/radio.log" "$flockmap" radio "${address[1]}" "${address[2]}" "${address[3]}" "${address[4]}" --listen 10.77.0.100:7800 \
    --loss "$LOSS" --delay-ms "$DELAY_MS" --json "$dir/radio.json"
radio=$started
for n in 1 2; do
    start "$n" "$dir/$n.log" "$flockmap_ros" --config "$dir/$n.toml" --ros-args -r "__ns:=/robot$n" -r __node:=flockmap \
        -p use_sim_time:=true
    eval "node_$n=$started"
    topics="/diagnostics"
    for output in occupied_points occupied_points_all grid grid_updates octomap_binary distance_field robots; do
        topics="$topics /robot$n/flockmap/$output"
    done
    eval "topics_$n=\$topics"
    # shellcheck disable=SC2086 # words
    start "$n" "$dir/early$n.log" "$PYTHON" "$TESTS/listen.py" $topics --out "$dir/early$n"
    eval "early_$n=$started"
done
sleep 2
players=()
for n in 1 2; do
    start "$n" "$dir/play$n.log" "$PYTHON" "$TESTS/play.py" "$records/robot$n.mcap" --clock --rate "$RATE" --seconds "$PLAY_S" \
        --sent "$dir/sent$n.jsonl" --linger "$SETTLE_S"
    players+=("$started")
done
wait "${players[@]}" || { cat "$dir"/play?.log; exit 1; }
cat "$dir"/play?.log
for n in 1 2; do
    # shellcheck disable=SC2154 # set by eval
    eval "pid=\$node_$n"
    kill -0 "$pid" 2> /dev/null || { echo "robot $n ended:"; tail -20 "$dir/$n.log"; exit 1; }
    seconds=$(awk -v hz="$(getconf CLK_TCK)" '{ print ($14 + $15) / hz }' "/proc/$pid/stat")
    age=$(ps -o etimes= -p "$pid" | tr -d " ")
    echo "robot $n: processor time $seconds s of $age s, most memory $(awk '/VmHWM/ { print $2 }' "/proc/$pid/status") kB," \
        "out of the radio $(ip netns exec "$name-$n" cat /sys/class/net/radio/statistics/tx_bytes) bytes" | tee "$dir/cost$n.txt"
done
# Subscribers that come when all is over.
late=()
for n in 1 2; do
    eval "topics=\$topics_$n"
    # shellcheck disable=SC2086 # words
    start "$n" "$dir/late$n.log" "$PYTHON" "$TESTS/listen.py" $topics --out "$dir/late$n" --for 6
    late+=("$started")
done
observers=()
for n in 3 4; do
    start 0 "$dir/$n.log" "$flockmap" node --config "$dir/$n.toml"
    observers+=("$started")
done
wait "${late[@]}" "${observers[@]}" || { tail -5 "$dir"/late?.log "$dir"/[34].log; exit 1; }
kill -TERM "$early_1" "$early_2" "$node_1" "$node_2"
result=0
for n in 1 2; do
    eval "wait \$early_$n; wait \$node_$n" || { echo "robot $n failed:"; tail -20 "$dir/$n.log"; result=1; }
done
kill -TERM "$radio"
wait "$radio" || true
tail -3 "$dir/radio.log"

compare() { "$PYTHON" "$TESTS/compare.py" "$@" || result=1; }
needed="occupied_points occupied_points_all grid grid_updates octomap_binary distance_field robots"
for n in 1 2; do
    echo "-- robot $n"
    compare counts "$dir/sent$n.jsonl" "$dir/early$n"
    for who in early late; do
        echo "   $who subscriber"
        # shellcheck disable=SC2046,SC2086 # words
        compare map "$dir/$n.bt" "$dir/$who$n" --position $("$PYTHON" "$TESTS/compare.py" position "$dir/sent$n.jsonl") --need $needed
    done
    for output in occupied_points occupied_points_all "grid grid_updates" distance_field; do
        files=()
        for part in $output; do files+=("$dir/early$n/$part.jsonl"); done
        compare latency "$dir/sent$n.jsonl" "${files[@]}"
    done
done
echo "-- layers"
compare streams "$dir"/[1234].json
# The player's --seconds is that of export too: from the first message on.
for n in 1 2; do
    "$flockmap" export "$records/robot$n.mcap" --to "$dir/reference$n.bt" --resolution "$RESOLUTION" --range "$RANGE" --seconds "$PLAY_S" \
        > "$dir/export$n.log" 2>&1
    compare layer "$dir/reference$n.bt" "$dir/$((n + 2)).bt"
done
"$flockmap" replay "$records/robot1.mcap" "$records/robot2.mcap" --resolution "$RESOLUTION" --range "$RANGE" --loss "$LOSS" \
    --seconds "$PLAY_S" | grep -A5 'layers held' || result=1
compare share "$dir/1.bt" "$dir/2.bt"
if [ $result = 0 ]; then
    echo "two robots: all equal"
    [ -z "$temporary" ] || rm -r "$temporary"
else
    echo "two robots: NOT all equal, see $dir"
fi
exit $result
