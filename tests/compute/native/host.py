"""The kernels' headers for a host compiler: files, warnings, and a library of their functions."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

from compute.native.headers import header_text

ROOT: Final = Path(__file__).parents[3]
FUNCTIONS: Final = Path(__file__).with_name("functions.cpp")
WARNINGS: Final = ("-Wall", "-Wextra", "-Werror", "-Wno-psabi")


def compiler() -> str | None:
    """Return the path of a C++ compiler, of the environment variable CXX first; None: none."""
    names = (os.environ.get("CXX", ""), "c++", "g++", "clang++")
    return next((found for name in names if name and (found := shutil.which(name))), None)


def headers() -> list[str]:
    """Return the paths of all headers from the root."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / "compute").rglob("native/*.h"))


def write_generated(folder: Path) -> None:
    """Write the headers that are made of Python into a folder, for ``-I``."""
    for path in sorted((ROOT / "compute").rglob("native/definitions.py")):
        name = str(path.relative_to(ROOT).with_suffix(".gen.h"))
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("#pragma once\n" + header_text(name))


def run(folder: Path, *arguments: str) -> str:
    """Run the compiler with the headers' folders; return what it says, "" if all is well."""
    found = compiler()
    assert found is not None
    command = [found, "-std=c++17", *WARNINGS, f"-I{ROOT}", f"-I{folder}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stderr + done.stdout if done.returncode else ""
