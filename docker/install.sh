#!/bin/sh
# Installs Lumiline, server and client, with its pinned dependencies into a virtual environment: in an image, or anywhere.
# Usage: docker/install.sh SOURCE VENV [PYTHON]
set -eu
source_dir=$1
venv=$2
python=${3:-python3.11}
here=$(dirname "$0")
test -x "$venv/bin/python" || "$python" -m venv "$venv"
PIP_CONSTRAINT=$source_dir/constraints.txt PIP_BUILD_CONSTRAINT=$source_dir/constraints.txt \
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    "$source_dir/lumiline" "${source_dir}[bus,export]"
for name in start healthcheck; do
    install -m 755 "$here/$name.sh" "$venv/bin/lumiline-$name"
done
"$venv/bin/lumiline" --version
