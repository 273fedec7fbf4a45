"""The worker's process: results, errors, limits, and its end with its parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from compute.errors import NoConvergence
from service.jobs.worker_process import WorkerProcess, call_in_process
from service.problems.errors import WorkerEnded
from tests.service.jobs import slow_tasks

LIMITS = {"timeout_s": 60.0, "memory_bytes": 2**31}


def test_a_result_comes_back_from_a_nice_process_with_one_thread():
    found = call_in_process(slow_tasks.settings_of_process, **LIMITS)
    assert found == {"niceness": os.nice(0) + 10, "threads": "1"}


def test_errors_come_back_as_they_were():
    with pytest.raises(NoConvergence) as error:
        call_in_process(slow_tasks.fail, **LIMITS)
    assert error.value.detail == "it ran away"
    assert error.value.context == {"sensor": "left"}
    with pytest.raises(RuntimeError, match="a secret path"):
        call_in_process(slow_tasks.break_down, **LIMITS)


def test_a_process_that_dies_is_told():
    with pytest.raises(WorkerEnded, match="exit code 7"):
        call_in_process(slow_tasks.die, **LIMITS)


def test_a_process_may_take_no_more_memory_than_its_limit():
    with pytest.raises(RuntimeError, match="memory"):
        call_in_process(slow_tasks.take_memory, **LIMITS)


def test_a_process_may_take_no_longer_than_its_limit(tmp_path: Path):
    with pytest.raises(WorkerEnded, match=r"longer than 0\.5 s"):
        call_in_process(
            slow_tasks.wait_for_file,
            str(tmp_path / "never"),
            timeout_s=0.5,
            memory_bytes=2**31,
        )


def test_killing_ends_the_process(tmp_path: Path):
    with WorkerProcess(slow_tasks.wait_for_end, str(tmp_path / "pid")) as worker:
        assert worker.next(60.0) is not None
        pid = worker.pid
        assert pid is not None
        assert is_running(pid)
    assert not is_running(pid)


def test_process_ends_by_the_signal_of_a_parent_that_exits(tmp_path: Path):
    with WorkerProcess(slow_tasks.wait_for_end, str(tmp_path / "pid")) as worker:
        assert worker.next(60.0) is not None
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGTERM)
        with pytest.raises(WorkerEnded, match=f"exit code {-signal.SIGTERM}"):
            worker.next(60.0)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "goes_on"), [(signal.SIGTERM, True), (signal.SIGKILL, False)])
def test_process_that_workers_are_forked_from_is_replaced_only_when_it_is_gone(
    number: signal.Signals, goes_on: bool
):
    first = call_in_process(slow_tasks.parent_of_process, **LIMITS)
    os.kill(first, number)
    end = time.monotonic() + 240.0
    while not goes_on and is_running(first):
        assert time.monotonic() < end
        time.sleep(0.01)
    assert (call_in_process(slow_tasks.parent_of_process, **LIMITS) == first) is goes_on


@pytest.mark.slow
def test_a_process_ends_with_its_parent(tmp_path: Path):
    text = (
        "import os, sys\n"
        "from service.jobs.worker_process import WorkerProcess\n"
        "from tests.service.jobs import slow_tasks\n"
        "if __name__ == '__main__':\n"
        "    worker = WorkerProcess(slow_tasks.wait_for_end, sys.argv[1])\n"
        "    worker.next(60.0)\n"
        "    os._exit(0)\n"  # as kill -9 would: nothing is cleaned up
    )
    program = tmp_path / "parent.py"
    program.write_text(text)
    subprocess.run(
        [sys.executable, str(program), str(tmp_path / "pid")],
        check=True,
        timeout=60,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
    )
    pid = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 240.0
    while is_running(pid):
        assert time.monotonic() < end, "the process outlives its parent"
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
