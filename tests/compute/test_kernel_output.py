"""Starting the kernels writes nothing: commands print JSON to standard output."""

import subprocess
import sys

import pytest

STARTS = {
    "points": "from compute.reconstruction.solver import load_kernels as f; f(4, 'cpu')",
    "any device": "import warp; from compute.warp_host import warp_device as f; f(warp, None)",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STARTS)
def test_starting_kernels_in_a_new_process_prints_nothing(name: str) -> None:
    done = subprocess.run([sys.executable, "-c", STARTS[name]], capture_output=True, timeout=240)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout == b""
