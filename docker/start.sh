#!/bin/sh
# Runs `lumiline "$@"`; all that it and its libraries write lies in LUMILINE_DATA_DIR.
# A machine whose CPU or GPU is not the one that the kernels were built for builds its own, once.
set -eu
venv=$(dirname "$(dirname "$(readlink -f "$0")")")
built=$venv/share/lumiline/cache
cache=${LUMILINE_DATA_DIR:?}/cache
mkdir -p "$cache"
if test -e "$built/stamp" && ! cmp -s "$built/stamp" "$cache/stamp"; then
    # The stamp last: a copy that was cut short is made again.
    for part in warp matplotlib; do cp -R "$built/$part" "$cache/"; done
    cp "$built/stamp" "$cache/stamp"
fi
export WARP_CACHE_PATH="$cache/warp" MPLCONFIGDIR="$cache/matplotlib"
exec "$venv/bin/lumiline" "$@"
