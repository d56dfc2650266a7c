#!/bin/sh
# Three robots in three network namespaces on one bridge. One is killed with SIGKILL in mid-flight and started again,
# with an empty store and a new epoch. At the end all three must hold equal layers of every stream.
#
# usage: three_nodes.sh DIR COMMAND
#   DIR has 1.toml, 2.toml, 3.toml, and 2-again.toml for the second run of robot 2. They bind 10.77.0.N:7700, and write
#   their summaries to 1.json, 2-again.json and 3.json in DIR.
#   COMMAND runs a node with the configuration $FLOCKMAP_NODE_CONFIG, for example
#   'exec flockmap node --config "$FLOCKMAP_NODE_CONFIG"'.
#   KILL_AFTER_S (default 4) and DOWN_S (default 2) say when robot 2 is killed, and for how long.
# exit: 0 equal, 1 not equal or failed, 77 skipped.
set -eu
. "$(dirname "$0")/layers.sh"

dir=$1
command=$2
name=flockmap$$
pids=

if ! command -v ip > /dev/null || ! ip netns add "$name-0" 2> /dev/null; then
    echo "skipped: network namespaces are not allowed here (ip netns needs root)"
    exit 77
fi
cleanup() {
    for pid in $pids; do kill -9 "$pid" 2> /dev/null || true; done
    for n in 0 1 2 3; do ip netns del "$name-$n" 2> /dev/null || true; done
}
trap cleanup EXIT
trap 'exit 1' INT TERM

# The bridge has a namespace of its own, so nothing of the machine is touched.
if ! ip -n "$name-0" link add bridge type bridge 2> /dev/null; then
    echo "skipped: no bridges here"
    exit 77
fi
ip -n "$name-0" link set bridge up
for n in 1 2 3; do
    ip netns add "$name-$n"
    ip -n "$name-$n" link add radio type veth peer name "robot$n" netns "$name-0" || {
        echo "skipped: no veth pairs here"
        exit 77
    }
    ip -n "$name-0" link set "robot$n" master bridge up
    ip -n "$name-$n" addr add "10.77.0.$n/24" dev radio
    ip -n "$name-$n" link set lo up
    ip -n "$name-$n" link set radio up
done

# Starts the node of namespace $1 with configuration $2; its pid is in $started.
start() {
    FLOCKMAP_NODE_CONFIG="$dir/$2.toml" ip netns exec "$name-$1" sh -c "$command" > "$dir/$2.log" 2>&1 &
    started=$!
    pids="$pids $started"
}
start 1 1; first=$started
start 2 2; second=$started
start 3 3; third=$started
sleep "${KILL_AFTER_S:-4}"
kill -9 "$second"
wait "$second" 2> /dev/null || true
echo "robot 2 killed"
sleep "${DOWN_S:-2}"
start 2 2-again; second=$started
echo "robot 2 started again"

for run in "1 $first" "2-again $second" "3 $third"; do
    wait "${run#* }" || {
        echo "robot ${run% *} failed:"
        cat "$dir/${run% *}.log"
        exit 1
    }
done

# One stream of each robot, and two of the one that was killed.
equal_layers 4 1 2-again 3 || exit 1
echo "three robots hold equal layers of 4 streams"
