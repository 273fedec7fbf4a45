#!/bin/sh
# Does as the Dockerfile does, in a temporary directory: installs, prebuilds, starts the service from
# the result, waits for its health check and stops it. Usage: docker/check.sh [PYTHON]
set -eu
source_dir=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
pid=
finish() {
    test -z "$pid" || kill "$pid" 2>/dev/null || true
    rm -rf "$work"
}
trap finish EXIT
fail() {
    echo "docker/check.sh: $1" >&2
    test ! -e "$work/log" || tail -n 30 "$work/log" >&2
    exit 1
}

# What the images copy, and nothing else.
mkdir "$work/src"
for part in compute hardware service lumiline migrations validation benchmarks docker \
    pyproject.toml constraints.txt README.md LICENSE; do
    grep -qx "!$part" "$source_dir/docker/Dockerfile.dockerignore" || fail "$part is not copied"
    cp -R "$source_dir/$part" "$work/src/"
done
"$work/src/docker/install.sh" "$work/src" "$work/venv" "${1:-python3.11}"
"$work/src/docker/prebuild.sh" "$work/venv"
rm -rf "$work/src"
touch "$work/built"

port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
mkdir "$work/data"
(
    cd "$work/data"
    exec env -i PATH="$work/venv/bin:/usr/bin:/bin" HOME=/nonexistent PYTHONDONTWRITEBYTECODE=1 \
        LUMILINE_HOST=0.0.0.0 LUMILINE_PORT="$port" LUMILINE_DATA_DIR="$work/data" \
        LUMILINE_LOG_FORMAT=json LUMILINE_COMPUTE_DEVICE=cpu lumiline-start serve
) 2>"$work/log" &
pid=$!
for _ in $(seq 600); do
    kill -0 "$pid" 2>/dev/null || fail "the service ended"
    if LUMILINE_PORT=$port "$work/venv/bin/lumiline-healthcheck" 2>/dev/null; then break; fi
    sleep 0.2
done
LUMILINE_PORT=$port "$work/venv/bin/lumiline-healthcheck" || fail "the service is not healthy"
# A health check that cannot fail would say nothing.
! LUMILINE_PORT=1 "$work/venv/bin/lumiline-healthcheck" 2>/dev/null || fail "healthy on port 1"
kill -TERM "$pid"
wait "$pid" || fail "the service ended with exit code $?"
pid=
# A read-only root file system has to do: nothing but the data directory was written to.
written=$(find "$work/venv" -newer "$work/built")
test -z "$written" || fail "written outside of the data directory: $written"
# All kernels that the start needed were built before it.
new=$(find "$work/data/cache/warp" -type f -newer "$work/data/cache/stamp")
test -z "$new" || fail "kernels were built at the start: $new"
echo "docker/check.sh: installed, prebuilt, started, healthy, stopped"
