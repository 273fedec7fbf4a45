#!/bin/sh
# Succeeds when the service is ready. Usage: docker/healthcheck.sh [VENV]
set -eu
exec "${1:-/opt/lumiline}/bin/python" -c '
import os, sys, httpx
port = os.environ.get("LUMILINE_PORT", "8000")
sys.exit(httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=3).status_code != 200)
'
