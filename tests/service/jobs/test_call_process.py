"""CallProcess: results, errors and bounds of calls that follow each other in one process."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest

from compute.errors import NoConvergence
from service.jobs import call_process
from service.jobs.call_process import CallProcess
from service.problems.errors import WorkerEnded

LONG_S = 60.0


@pytest.fixture
def calls() -> Iterator[CallProcess]:
    process = CallProcess(2**31, 2**30)
    yield process
    process.close()


def own_number() -> int:
    return os.getpid()


def fail() -> None:
    raise NoConvergence("it ran away", sensor="left")


def die() -> None:
    os._exit(7)


def compute_without_end() -> None:
    while True:
        pass


def wait_without_computing() -> None:
    time.sleep(3600.0)


def tell_and_wait(path: str) -> None:
    Path(path).touch()
    time.sleep(3600.0)


@pytest.mark.slow
def test_calls_are_answered_by_one_process(calls: CallProcess) -> None:
    first = calls.call(own_number, timeout_s=LONG_S)
    with pytest.raises(NoConvergence) as error:
        calls.call(fail, timeout_s=LONG_S)
    assert error.value.context == {"sensor": "left"}
    assert calls.call(own_number, timeout_s=LONG_S) == first != os.getpid()


@pytest.mark.slow
def test_process_that_dies_is_told_and_replaced(calls: CallProcess) -> None:
    first = calls.call(own_number, timeout_s=LONG_S)
    with pytest.raises(WorkerEnded, match="ended without a result"):
        calls.call(die, timeout_s=LONG_S)
    assert calls.call(own_number, timeout_s=LONG_S) != first


@pytest.mark.slow
def test_call_that_computes_too_long_is_ended(
    calls: CallProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a busy machine half a second of a nice process's time takes a minute.
    monkeypatch.setattr(call_process, "_WAIT_FACTOR", 1e4)
    first = calls.call(own_number, timeout_s=LONG_S)
    with pytest.raises(WorkerEnded, match=r"computed for longer than 0\.5 s"):
        calls.call(compute_without_end, timeout_s=0.5)
    assert calls.call(own_number, timeout_s=LONG_S) != first


@pytest.mark.slow
def test_call_that_waits_for_others_may_take_longer_than_it_computes(
    calls: CallProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls.call(own_number, timeout_s=LONG_S)
    with pytest.raises(WorkerEnded, match=r"took longer than 0\.5 s"):
        calls.call(wait_without_computing, timeout_s=0.05)
    monkeypatch.setattr(call_process, "_WAIT_FACTOR", 1e4)
    calls.call(own_number, timeout_s=LONG_S)
    calls.call(time.sleep, 0.6, timeout_s=0.3)


def test_closing_ends_a_call_in_progress_and_refuses_later_ones(
    calls: CallProcess, tmp_path: Path
) -> None:
    begun, raised = tmp_path / "begun", []

    def call() -> None:
        with pytest.raises(WorkerEnded) as error:
            calls.call(tell_and_wait, str(begun), timeout_s=3600.0)
        raised.append(error.value.detail)

    threads = [Thread(target=call, daemon=True) for _ in range(2)]  # one waits for the other
    for thread in threads:
        thread.start()
    end = time.monotonic() + 240.0
    while not begun.exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    closing = Thread(target=calls.close, daemon=True)
    closing.start()
    for thread in (closing, *threads):
        thread.join(240.0)
        assert not thread.is_alive(), "it waits for the computation"
    assert len(raised) == 2
    assert all("the server stops" in detail for detail in raised)
    with pytest.raises(WorkerEnded, match="the server stops"):
        calls.call(own_number, timeout_s=LONG_S)
    assert calls._process is None


@pytest.mark.parametrize("known", [False, True])
def test_closing_while_the_process_is_started_ends_it(
    calls: CallProcess, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    start = calls._start

    def start_and_close() -> None:
        if not known:
            calls.close()
        start()
        if known:
            calls.close()

    monkeypatch.setattr(calls, "_start", start_and_close)
    with pytest.raises(WorkerEnded, match="the server stops"):
        calls.call(own_number, timeout_s=LONG_S)
    assert calls._process is None
