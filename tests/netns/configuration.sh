# Read by the scripts beside it: configurations of nodes that fly the records of $dir, each with all of $robots as peers. Where one
# listens `address ROBOT` says, and where others find it `appears ROBOT`; or by broadcast, if $everyone is where to send to.

# Writes $dir/RUN.toml, of a run of a robot that begins so far into its record.
configuration() { # ROBOT RUN START_S
    peers= cast=unicast
    [ -z "${everyone:-}" ] || cast=broadcast
    for other in $robots; do
        [ "$other" = "$1" ] || [ $cast = broadcast ] || peers="$peers\"$(appears "$other")\", "
    done
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
