"""BeamHoldWatchdog: a thread that holds the beam when no frames come, which nobody else would notice.

The compute thread runs on frames, and the event loop may be busy with requests; this thread has
nothing else to do, and sleeps while no beam is on.
"""

import logging
from threading import Thread
from typing import Final

from service.pipeline.beam_hold_registry import BeamHoldRegistry

_log = logging.getLogger(__name__)

_AGAIN_S: Final = 0.05
"""Until a check that failed is tried again."""


class BeamHoldWatchdog:
    """Checks a board at each deadline, from ``start`` to ``close``."""

    def __init__(self, board: BeamHoldRegistry) -> None:
        self._board = board
        self._closing = False
        self._thread = Thread(target=self._run, name="hold-watchdog", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End it."""
        with self._board.changed:
            self._closing = True
            self._board.changed.notify_all()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not self._closing:
            # One hold of the lock for both: what is released in between would be waited for.
            with self._board.changed:
                try:
                    wait_s = self._board.check()
                except Exception:  # noqa: BLE001 - it must go on
                    _log.exception("beam holds could not be checked")
                    wait_s = _AGAIN_S
                if not self._closing:
                    self._board.changed.wait(wait_s)
