#!/usr/bin/env bash
# The planner of the examples on the mirror of a real node, which maps a simulated flight through a forest.
#
# usage: scripts/planner.sh PLANNER FLOCKMAP
# exit: that of the planner
set -euo pipefail
[ $# = 2 ] || { sed -n '2,5p' "$0" >&2; exit 2; }
planner=$(realpath "$1") flockmap=$(realpath "$2")
OUT=$(mktemp -d)
node=
trap '[ -z "$node" ] || kill "$node" 2> /dev/null || true; rm -rf "$OUT"' EXIT
"$flockmap" sim fly --scene forest --robots 1 --seconds 6 --out "$OUT/flight" > "$OUT/fly.log" 2>&1 || { cat "$OUT/fly.log" >&2; exit 1; }
cat > "$OUT/node.toml" << END
id = 1
[map]
resolution_m = 0.2
range_m = 10.0
[state]
path = "state"
[network]
bind = "127.0.0.1:0"
[sensor]
record = "flight/robot1.mcap"
[map_output]
listen_unix = "map.sock"
[output]
end_when_quiet_s = 3
END
"$flockmap" node --config "$OUT/node.toml" > "$OUT/node.json" 2> "$OUT/node.log" &
node=$!
for _ in $(seq 600); do
    grep -q "gives the map out" "$OUT/node.log" && break
    kill -0 "$node" 2> /dev/null || { cat "$OUT/node.log" >&2; exit 1; }
    sleep 0.1
done
"$planner" "unix:$OUT/map.sock"
