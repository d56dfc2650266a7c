#!/bin/sh
# Five robots beside cross traffic, all on one link with a rate cap: the loopback of a network namespace of their own, with tbf
# on it. Nobody tells the robots a budget. In the end all five must hold equal layers; the robots must have got 25 % of the
# link and the cross traffic 40 %, from the 8th second until the last package had arrived.
#
# usage: cross_traffic.sh FLOCKMAP [DIR]
#   FLOCKMAP is the program; records, configurations, logs and summaries go to DIR (default: a new folder, removed at the end).
# environment, with defaults: RATE_KBIT=50 QUEUE_BYTES=16384 CROSS=tcp (or udp: at CROSS_KBIT=30, whatever becomes of it)
#   CAST=unicast (or broadcast: one datagram for all)
#   FLIGHT_S=40 QUIET_S=45 (a robot ends when its record is over and nothing new has come for so long)
# needs: root, ip and tc with tbf, python3 (the stream). exit: 0 as it must be, 1 not so, 77 skipped.
set -eu
. "$(dirname "$0")/configuration.sh"
. "$(dirname "$0")/layers.sh"

flockmap=$1
dir=${2:-}
RATE_KBIT=${RATE_KBIT:-50} QUEUE_BYTES=${QUEUE_BYTES:-16384} CROSS=${CROSS:-tcp} CROSS_KBIT=${CROSS_KBIT:-30} CAST=${CAST:-unicast}
FLIGHT_S=${FLIGHT_S:-40} QUIET_S=${QUIET_S:-45}
robots="1 2 3 4 5"
name=flockmap$$
pids=
temporary=

if ! ip netns add "$name" 2> /dev/null; then
    echo "skipped: network namespaces are not allowed here (ip netns needs root)"
    exit 77
fi
cleanup() {
    for pid in $pids; do kill -9 "$pid" 2> /dev/null || true; done
    ip netns del "$name" 2> /dev/null || true
    [ -z "$temporary" ] || rm -rf "$temporary"
}
trap cleanup EXIT
trap 'exit 1' INT TERM
if [ -z "$dir" ]; then
    dir=$(mktemp -d)
    temporary=$dir
fi
mkdir -p "$dir"
# Packets as on a radio, not of 64 KiB.
ip -n "$name" link set lo mtu 1500 up
if ! tc -n "$name" qdisc add dev lo root tbf rate "${RATE_KBIT}kbit" burst 2kb limit "$QUEUE_BYTES" 2> /dev/null; then
    echo "skipped: no tbf here"
    exit 77
fi
"$flockmap" sim fly --scene indoor --robots 5 --seconds "$FLIGHT_S" --lidar mid360 --resolution 0.2 --no-view --out "$dir" \
    > "$dir/fly.log"

cat > "$dir/stream.py" << 'END'
"""stream.py tcp|udp KBIT: sends over the loopback, writes seconds, bytes received."""
import socket, sys, threading, time

kind, bytes_per_s = sys.argv[1], float(sys.argv[2]) * 125
address, received, began = ("127.0.0.1", 9000), [0], time.time()
stream = socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM
there = socket.socket(socket.AF_INET, stream)
there.bind(address)
if kind == "tcp":
    there.listen(1)

def receive():
    taker = there.accept()[0] if kind == "tcp" else there
    while data := taker.recv(65536):
        received[0] += len(data)

def send():
    here, sent = socket.socket(socket.AF_INET, stream), 0
    here.connect(address)
    while kind == "tcp":
        here.sendall(bytes(8192))
    while True:
        while sent < bytes_per_s * (time.time() - began):
            here.send(bytes(1000))
            sent += 1042  # with IP, UDP and the link's header
        time.sleep(0.005)

for work in receive, send:
    threading.Thread(target=work, daemon=True).start()
while True:
    time.sleep(1)
    print(f"{time.time() - began:.1f} {received[0]}", flush=True)
END

case $CAST in
    unicast) everyone= ;;
    broadcast) everyone=127.255.255.255:7700 ;;
    *) echo "CAST is $CAST, expected unicast or broadcast" >&2 && exit 1 ;;
esac
address() { echo "127.0.0.1:770$1"; }
appears() { address "$1"; }
for n in $robots; do
    configuration "$n" "$n" 2.0
    ip netns exec "$name" "$flockmap" node --config "$dir/$n.toml" > /dev/null 2> "$dir/$n.log" &
    pids="$pids $!"
done
nodes=$pids
ip netns exec "$name" python3 "$dir/stream.py" "$CROSS" "$CROSS_KBIT" > "$dir/cross.txt" &
pids="$pids $!"
began=$(date +%s)
(
    while sleep 1; do
        echo "$(($(date +%s) - began)) $(tc -n "$name" -s qdisc show dev lo | sed -n 's/^ Sent \([0-9]*\) bytes.*/\1/p')"
    done
) > "$dir/link.txt" &
pids="$pids $!"
for pid in $nodes; do
    wait "$pid" || {
        echo "a robot failed:"
        tail -n 3 "$dir"/?.log
        exit 1
    }
done
ended=$(($(date +%s) - began - QUIET_S))

equal_layers 5 $robots || exit 1
bytes_at() { awk -v at="$2" '$1 <= at { bytes = $2 } END { print bytes + 0 }' "$dir/$1"; }
cross=$(($(bytes_at cross.txt "$ended") - $(bytes_at cross.txt 8)))
all=$(($(bytes_at link.txt "$ended") - $(bytes_at link.txt 8)))
could=$(((ended - 8) * RATE_KBIT * 125))
# With headers of 66 bytes for 1,448 the cross traffic is a twentieth more.
ours=$(((all - cross * 21 / 20) * 100 / could)) theirs=$((cross * 100 / could))
echo "five robots hold equal layers after $ended s; of the link ($RATE_KBIT kbit/s, $CROSS, $CAST) robots $ours %, cross traffic $theirs %"
[ "$ours" -ge 25 ] && [ "$theirs" -ge 40 ]
