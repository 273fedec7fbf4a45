#!/bin/sh
# Builds what a first start would build, into VENV/share/lumiline/cache, from where
# lumiline-start copies it: kernels for this CPU, or for GPUs, and matplotlib's list of fonts.
# Usage: docker/prebuild.sh VENV [GPU_ARCHITECTURE...]; 80 is compute capability 8.0
set -eu
venv=$1
shift
cache=$venv/share/lumiline/cache
mkdir -p "$cache/warp" "$cache/matplotlib"
export WARP_CACHE_PATH="$cache/warp" MPLCONFIGDIR="$cache/matplotlib"
"$venv/bin/python" "$(dirname "$0")/build_kernels.py" "$@"
"$venv/bin/python" -c "import matplotlib.font_manager"
# Of another build, another one: lumiline-start compares it.
find "$cache" -type f ! -name stamp -exec cksum {} + | sort | cksum > "$cache/stamp"
