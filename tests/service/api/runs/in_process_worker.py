"""A worker in the place of a run's process: for what is made and stored, not how it is computed.

A process takes seconds to load what it computes with; tests of processes have real ones.
"""

import pickle
from collections.abc import Callable
from threading import Event
from typing import Any, Self

import pytest

from service.jobs import run_manager
from service.jobs.worker import Done


class InProcessWorker:
    """Computes at once, in the manager's thread, when ``gate`` is open."""

    gate = Event()

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._task = pickle.dumps((function, arguments))

    def next(self, wait_s: float) -> Done | None:
        """Return the result; as from a process, it has been pickled."""
        if not self.gate.wait(wait_s):
            return None
        function, arguments = pickle.loads(self._task)
        result = function(lambda share, stage: None, *arguments)
        return Done(pickle.loads(pickle.dumps(result)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def use_in_process_worker(patch: pytest.MonkeyPatch, *, closed: bool = False) -> Event:
    """Let runs be computed at hand; returns the gate, which runs wait for where it is closed."""
    gate = Event()
    if not closed:
        gate.set()
    patch.setattr(InProcessWorker, "gate", gate)
    patch.setattr(run_manager, "WorkerProcess", InProcessWorker)
    return gate
