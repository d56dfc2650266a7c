#!/bin/sh
# Five robots on a bad radio: each in a network namespace of its own behind a link with a rate cap (tbf), all of them through
# `flockmap radio` at 30 % loss and 40 ms delay. For a while robots 1, 2 and robots 3, 4, 5 do not hear each other. In that time
# robot 5 is killed with SIGKILL and started again, with an empty store and a new epoch. At the end all five must hold equal
# layers of every stream.
#
# usage: five_nodes.sh FLOCKMAP [DIR]
#   FLOCKMAP is the program; records, configurations, logs and summaries go to DIR (default: a new folder, removed at the end).
#   Where network namespaces are not allowed, the same runs on the loopback, with the rate cap in the radio.
# environment, with defaults: LOSS=0.3 DELAY_MS=40 JITTER_MS=10 RATE_KBIT=2000 FLIGHT_S=45 SPLIT_AT_S=8 SPLIT_S=20 KILL_AT_S=12
#   DOWN_S=4 QUIET_S=10 (a robot ends when its record is over and nothing new has come for so long), NO_NETNS=1: the loopback.
# exit: 0 equal, 1 not equal or failed.
set -eu
. "$(dirname "$0")/configuration.sh"

flockmap=$1
dir=${2:-}
LOSS=${LOSS:-0.3} DELAY_MS=${DELAY_MS:-40} JITTER_MS=${JITTER_MS:-10} RATE_KBIT=${RATE_KBIT:-2000}
FLIGHT_S=${FLIGHT_S:-45} SPLIT_AT_S=${SPLIT_AT_S:-8} SPLIT_S=${SPLIT_S:-20} KILL_AT_S=${KILL_AT_S:-12} DOWN_S=${DOWN_S:-4}
QUIET_S=${QUIET_S:-10}
robots="1 2 3 4 5"
name=flockmap$$
pids=
temporary=

if [ -z "$dir" ]; then
    dir=$(mktemp -d)
    temporary=$dir
fi
mkdir -p "$dir"
cleanup() {
    for pid in $pids; do kill -9 "$pid" 2> /dev/null || true; done
    if [ $netns = 1 ]; then
        for n in 0 $robots; do ip netns del "$name-$n" 2> /dev/null || true; done
    fi
    [ -z "$temporary" ] || rm -rf "$temporary"
}

# Whether namespaces, bridges, veth pairs and tbf are all to be had; the bridge has a namespace of its own, so that nothing of the
# machine is touched.
make_namespaces() {
    command -v ip > /dev/null && command -v tc > /dev/null || return 1
    ip netns add "$name-0" || return 1
    ip -n "$name-0" link add bridge type bridge || return 1
    ip -n "$name-0" link set lo up
    ip -n "$name-0" addr add 10.77.0.100/24 dev bridge
    ip -n "$name-0" link set bridge up
    for n in $robots; do
        ip netns add "$name-$n"
        ip -n "$name-$n" link add radio type veth peer name "robot$n" netns "$name-0" || return 1
        ip -n "$name-0" link set "robot$n" master bridge up
        ip -n "$name-$n" addr add "10.77.0.$n/24" dev radio
        ip -n "$name-$n" link set lo up
        ip -n "$name-$n" link set radio up
        # Both directions.
        tc -n "$name-$n" qdisc add dev radio root tbf rate "${RATE_KBIT}kbit" burst 8kb latency 200ms || return 1
        tc -n "$name-0" qdisc add dev "robot$n" root tbf rate "${RATE_KBIT}kbit" burst 8kb latency 200ms || return 1
    done
}
netns=1
trap cleanup EXIT
trap 'exit 1' INT TERM
if [ -n "${NO_NETNS:-}" ] || ! make_namespaces 2> /dev/null; then
    for n in 0 $robots; do ip netns del "$name-$n" 2> /dev/null || true; done
    netns=0
    echo "no network namespaces (they need root, ip and tc with tbf): five robots on the loopback"
fi
port=$((20000 + $$ % 120 * 100))
if [ $netns = 1 ]; then listen=10.77.0.100:7800; else listen=127.0.0.1:$port; fi
address() { if [ $netns = 1 ]; then echo "10.77.0.$1:7700"; else echo "127.0.0.1:$((port + 50 + $1))"; fi; }
appears() { echo "${listen%:*}:$((${listen#*:} + $1))"; }
within() { # NAMESPACE COMMAND...
    if [ $netns = 1 ]; then
        namespace=$name-$1
        shift
        exec ip netns exec "$namespace" "$@"
    fi
    shift
    exec "$@"
}

"$flockmap" sim fly --scene indoor --robots 5 --seconds "$FLIGHT_S" --lidar mid360 --resolution 0.2 --no-view --out "$dir" > "$dir/fly.log"

for n in $robots; do configuration "$n" "$n" 0.0; done
configuration 5 5-again $((KILL_AT_S + DOWN_S)).0

# Its pid is in $started.
start_node() { # ROBOT RUN
    (within "$1" "$flockmap" node --config "$dir/$2.toml") > /dev/null 2> "$dir/$2.log" &
    started=$!
    pids="$pids $started"
}
addresses=
for n in $robots; do addresses="$addresses $(address "$n")"; done
rate=
[ $netns = 1 ] || rate="--rate-kb-s $((RATE_KBIT / 8))"
# shellcheck disable=SC2086 # words
(within 0 "$flockmap" radio $addresses --listen "$listen" --loss "$LOSS" --delay-ms "$DELAY_MS" --jitter-ms "$JITTER_MS" $rate \
    --at "$SPLIT_AT_S split 1,2/3,4,5" --at "$((SPLIT_AT_S + SPLIT_S)) heal" --json "$dir/radio.json") \
    < /dev/null > "$dir/radio.log" 2>&1 &
radio=$!
pids="$pids $radio"
for n in $robots; do
    start_node "$n" "$n"
    eval "pid_$n=$started"
done
sleep "$KILL_AT_S"
# Of its first run something must be known, also where the machine is slow.
until grep -q ' \([2-9]\|[0-9][0-9]\) batches ' "$dir/5.log"; do
    kill -0 "$pid_5" || {
        echo "robot 5 ended before it had published anything:"
        cat "$dir/5.log"
        exit 1
    }
    sleep 0.2
done
kill -9 "$pid_5"
wait "$pid_5" 2> /dev/null || true
echo "robot 5 killed after $KILL_AT_S s"
sleep "$DOWN_S"
start_node 5 5-again
pid_5=$started
echo "robot 5 started again"

runs="1 2 3 4 5-again"
for run in $runs; do
    eval "wait \$pid_${run%-again}" || {
        echo "robot $run failed:"
        cat "$dir/$run.log"
        exit 1
    }
done
kill -TERM "$radio"
wait "$radio" || true
cat "$dir/radio.log"

# One line for each stream of a summary: origin, epoch, packages missing, voxels, digest.
streams() {
    sed -n 's/^      "\(origin\|epoch\|missing\|voxels\|digest\)": *"\{0,1\}\([^,"]*\)"\{0,1\},\{0,1\}$/\1 \2/p' "$1" |
        awk '{ line = line " " $2 } $1 == "digest" { print line; line = "" }'
}
result=0
for run in $runs; do
    echo "robot $run: origin, epoch, missing, voxels, digest"
    streams "$dir/$run.json" | tee "$dir/$run.streams"
    # Of the run that was killed the last packages may have reached nobody: what is missing there, nobody has.
    awk '{ print $1, $2, $4, $5 }' "$dir/$run.streams" > "$dir/$run.layers"
    if ! diff "$dir/1.layers" "$dir/$run.layers"; then
        echo "robots 1 and ${run%-again} differ"
        result=1
    fi
done
# The newest run of each origin is alive, and nothing of it may be missing.
for run in $runs; do
    if ! awk '{ missing[$1] = $3 } END { for (origin in missing) if (missing[origin] != 0) exit 1 }' "$dir/$run.streams"; then
        echo "robot $run misses packages of a robot that is there"
        result=1
    fi
done
count=$(wc -l < "$dir/1.layers")
if [ "$count" != 6 ]; then
    echo "$count streams, expected 6: one of each robot, and two of the one that was killed"
    result=1
fi
if awk '$3 < 1000 { few = 1 } END { exit !few }' "$dir/1.layers"; then
    echo "a layer has less than 1,000 voxels: nothing was flown?"
    result=1
fi
[ $result = 0 ] && echo "five robots hold equal layers of $count streams"
exit $result
