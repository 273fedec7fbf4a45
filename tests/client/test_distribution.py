"""The client as a distribution of its own: what it declares, contains and loads.

That its wheel runs alone in a fresh environment is a step of docker/check.sh.
"""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "lumiline"


def project(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text())


def test_client_imports_only_what_it_declares() -> None:
    declared = {
        re.split(r"[>=<;\[ ]", requirement)[0]
        for requirement in project(CLIENT)["project"]["dependencies"]
    }
    imported = set()
    for path in (CLIENT / "__init__.py", *(CLIENT / "client").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(str(node.module).split(".")[0])
    assert imported - set(sys.stdlib_module_names) - {"lumiline"} == declared


def test_client_wheel_has_every_package_and_the_server_none() -> None:
    packages = {
        ".".join(["lumiline", *path.parent.relative_to(CLIENT).parts])
        for path in (CLIENT / "__init__.py", *(CLIENT / "client").rglob("__init__.py"))
    }
    assert set(project(CLIENT)["tool"]["setuptools"]["packages"]) == packages
    assert "lumiline*" not in project(ROOT)["tool"]["setuptools"]["packages"]["find"]["include"]


def test_server_requires_the_client_of_its_own_version() -> None:
    server, client = project(ROOT)["project"], project(CLIENT)["project"]
    assert server["version"] == client["version"]
    assert f"{client['name']}=={client['version']}" in server["dependencies"]
    assert server["requires-python"] == client["requires-python"]
    # Where both need a library, they need the same versions.
    assert set(client["dependencies"]) <= set(server["dependencies"])


def test_import_of_the_client_loads_neither_the_server_nor_numpy() -> None:
    script = "import sys, lumiline.client; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert {"lumiline", "httpx", "websockets"} <= loaded
    assert not loaded & {"compute", "hardware", "service", "numpy", "scipy", "fastapi", "warp"}
