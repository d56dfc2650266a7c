# Read by the scripts beside it: whether robots hold equal layers, by their summaries RUN.json in $dir.

# What a summary says of its streams, without how the packages came.
layers() {
    sed -n 's/^      "\(origin\|epoch\|missing\|voxels\|digest\)": *\([^,]*\),\{0,1\}$/\1 \2/p' "$1"
}

# equal_layers STREAMS RUN...: whether all runs hold the same layers, of so many streams. Says what differs.
equal_layers() {
    expected=$1 first=$2 result=0
    shift 2
    layers "$dir/$first.json" > "$dir/expected"
    for run in "$@"; do
        layers "$dir/$run.json" > "$dir/found"
        if ! diff "$dir/expected" "$dir/found"; then
            echo "robots $first and ${run%-again} differ"
            result=1
        fi
    done
    streams=$(grep -c '^digest' "$dir/expected" || true)
    if [ "$streams" != "$expected" ]; then
        echo "$streams streams, expected $expected"
        result=1
    fi
    return $result
}
