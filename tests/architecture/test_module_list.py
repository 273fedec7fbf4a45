"""The module list of docs/architecture.md is up to date."""

import subprocess
import sys

from tests.architecture.walks import ROOT


def test_module_list_is_what_its_command_writes() -> None:
    command = [sys.executable, str(ROOT / "docs" / "generators" / "architecture.py"), "--check"]
    status = subprocess.run(command, check=False).returncode
    assert status == 0, "run `python docs/generators/architecture.py` (`make docs` does)"
