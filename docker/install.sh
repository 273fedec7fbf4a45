#!/bin/sh
# Installs Lumiline with its pinned dependencies into a virtual environment: in an image, or anywhere.
# Usage: docker/install.sh SOURCE VENV [PYTHON]
set -eu
source_dir=$1
venv=$2
python=${3:-python3.11}
test -x "$venv/bin/python" || "$python" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-cache-dir \
    --constraint "$source_dir/constraints.txt" "$source_dir"
"$venv/bin/lumiline" --version
