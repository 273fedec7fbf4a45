"""Benchmarks of a running service: they end with all that they have started."""

import os
import signal
import subprocess
import sys
import time

import pytest

WAIT_S = 240.0


def session_processes(session: int) -> list[str]:
    """Commands of the processes that run in a session."""
    command = ["ps", "-o", "stat=,args=", "-s", str(session)]
    listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    return [line for line in listed.splitlines() if not line.startswith("Z")]


@pytest.mark.slow
def test_sigterm_ends_the_benchmark_with_its_service():
    command = [sys.executable, "-m", "service.cli", "bench", "live", "--seconds", "600"]
    bench = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + WAIT_S
        while not any("service.station" in line for line in session_processes(bench.pid)):
            assert time.monotonic() < end, "no station was started"
            time.sleep(0.2)
        bench.terminate()
        assert bench.wait(WAIT_S) == 128 + signal.SIGTERM
        while left := session_processes(bench.pid):
            assert time.monotonic() < end + WAIT_S, left
            time.sleep(0.2)
    finally:
        if left := session_processes(bench.pid):
            os.killpg(bench.pid, signal.SIGKILL)
