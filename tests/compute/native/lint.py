"""Lints C and C++: the format of the kernels' headers, the firmware and the examples; warnings.

Usage: python -m tests.compute.native.lint
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.compute.native.host import FUNCTIONS, ROOT, compiler, headers, run, write_generated

FOLDERS: Final = ("hardware/serial/firmware", "docs/examples/cpp")
"""C and C++ besides the kernels'; tests compile them."""


def main() -> int:
    """Return the number of complaints, after they are printed."""
    formatter = Path(sys.executable).with_name("clang-format")
    others = sorted(path for folder in FOLDERS for path in (ROOT / folder).glob("*.[ch]*"))
    files = [*headers(), str(FUNCTIONS.relative_to(ROOT)), *map(str, others)]
    complaints = int(
        subprocess.run([formatter, "--dry-run", "-Werror", *files], cwd=ROOT).returncode != 0
    )
    if compiler() is None:
        print("no C++ compiler: the kernels' headers are not compiled")
        return complaints
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_generated(folder)
        # Each header alone, then all their templates.
        for header in headers():
            (folder / "alone.cpp").write_text(f'#include "{header}"\n')
            said = run(folder, "-fsyntax-only", str(folder / "alone.cpp"))
            complaints += bool(said)
            print(said, end="")
        said = run(folder, "-O1", "-c", str(FUNCTIONS), "-o", str(folder / "functions.o"))
        complaints += bool(said)
        print(said, end="")
    return complaints


if __name__ == "__main__":
    sys.exit(main())
