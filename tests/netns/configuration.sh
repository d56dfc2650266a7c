# Read by the scripts beside it: configurations of nodes that fly the records of $dir, each with all of $robots as peers. Where one
# listens `address ROBOT` says, and where others find it `appears ROBOT`. If $everyone is set, to a broadcast address, they
# broadcast to that and have no peers listed.

# Writes $dir/RUN.toml, of a run of a robot that begins so far into its record.
configuration() { # ROBOT RUN START_S
    peers= cast=broadcast
    if [ -z "${everyone:-}" ]; then
        cast=unicast
        for other in $robots; do
            [ "$other" = "$1" ] || peers="$peers\"$(appears "$other")\", "
        done
    fi
    cat > "$dir/$2.toml" << END
id = $1
name = "robot$2"
[map]
resolution_m = 0.2
range_m = 7.0
[state]
path = "state"
[session]
cast = "$cast"
[network]
bind = "$(address "$1")"
peers = [$peers]
${everyone:+broadcast = \"$everyone\"}
[sensor]
record = "robot$1.mcap"
start_s = $3
[output]
report_json = "$2.json"
end_when_quiet_s = $QUIET_S
END
}
