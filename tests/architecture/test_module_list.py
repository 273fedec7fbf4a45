"""The module list and the index of docs/architecture.md are up to date."""

import re
import subprocess
import sys

from tests.architecture.walks import PAGE, ROOT


def test_module_list_is_what_its_command_writes() -> None:
    command = [sys.executable, str(ROOT / "docs" / "generators" / "architecture.py"), "--check"]
    status = subprocess.run(command, check=False).returncode
    assert status == 0, "run `python docs/generators/architecture.py` (`make docs` does)"


def test_index_names_files_that_exist() -> None:
    section = PAGE.read_text().split("\n## Where to find it\n", 1)[1].split("\n## ", 1)[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    names = [name for row in rows for name in re.findall(r"`([\w./]+)`", row)]
    assert len(names) > len(rows)
    paths = [name if "/" in name else name.replace(".", "/") for name in names]
    assert [
        path for path in paths if not (ROOT / path).exists() and not (ROOT / f"{path}.py").is_file()
    ] == []
