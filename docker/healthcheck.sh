#!/bin/sh
# Succeeds when the service is ready. Installed beside the service's own Python.
set -eu
exec "$(dirname "$(readlink -f "$0")")/python" -c '
import os, sys, urllib.error, urllib.request
port = os.environ.get("LUMILINE_PORT", "8000")
try:
    urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=3)
except urllib.error.HTTPError as error:
    sys.exit(error.read().decode())
except OSError as error:
    sys.exit(f"port {port}: {error}")
'
