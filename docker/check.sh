#!/bin/sh
# Builds the wheels of client and server, and installs the client's alone. Then does as the Dockerfile
# does, in a temporary directory: installs, prebuilds, starts the service from the result, waits for
# its health check and stops it. Usage: docker/check.sh [PYTHON]
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
for part in compute hardware service lumiline migrations validation benchmarks dashboard \
    docker pyproject.toml constraints.txt README.md LICENSE MANIFEST.in; do
    grep -qx "!$part" "$source_dir/docker/Dockerfile.dockerignore" || fail "$part is not copied"
    tar -C "$source_dir" -c --exclude=__pycache__ --exclude=node_modules \
        --exclude=service/application/dashboard_page "$part" | tar -C "$work/src" -x
done

# The client is a distribution of its own: no file is in both wheels, and it runs without the server.
"${1:-python3.11}" -m venv "$work/client"
PIP_CONSTRAINT=$work/src/constraints.txt PIP_BUILD_CONSTRAINT=$work/src/constraints.txt
export PIP_CONSTRAINT PIP_BUILD_CONSTRAINT
for part in lumiline .; do
    "$work/client/bin/python" -m pip wheel --quiet --disable-pip-version-check --no-deps \
        --wheel-dir "$work/wheels" "$work/src/$part"
done
"$work/client/bin/python" -c '
import sys, zipfile
for wheel in sys.argv[1:]:
    print(*zipfile.ZipFile(wheel).namelist(), sep="\n")
' "$work"/wheels/*.whl | sort | uniq -d >"$work/twice"
test ! -s "$work/twice" || fail "in both wheels: $(cat "$work/twice")"
"$work/client/bin/python" -m pip install --quiet --disable-pip-version-check \
    "$work"/wheels/lumiline_client-*.whl
(
    cd "$work/wheels"
    "$work/client/bin/python" -I -c 'import lumiline.client; lumiline.client.Client().close()'
    ! "$work/client/bin/python" -I -c 'import numpy' 2>/dev/null
) || fail "the client does not run alone"
unset PIP_CONSTRAINT PIP_BUILD_CONSTRAINT
rm -rf "$work/src/build" "$work/src/lumiline/build"

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
# The wheel brings the dashboard, which was built from its sources above.
"$work/venv/bin/python" -I -c '
import re, sys, httpx
url = sys.argv[1]
script = re.search(r"dashboard/index-[^\"]*\.js", httpx.get(url).raise_for_status().text).group()
httpx.get(url + script).raise_for_status()
' "http://127.0.0.1:$port/" || fail "no dashboard is served"
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
echo "docker/check.sh: both wheels built, installed, prebuilt, started, healthy, with the dashboard, stopped"
