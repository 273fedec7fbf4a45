"""Driver for open TCD1304 boards: a frame is one scan of each board."""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np

from hardware.clock_sync import HostClock
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import ReportingDriver, most_severe
from hardware.serial.port import CloseSignal
from hardware.tcd1304.board import BoardFault, BoardLink, BoardScan
from hardware.tcd1304.protocol import BITS, FULL_SCALE, PITCH_UM, PIXELS
from hardware.tcd1304.response import dark_corrected_counts
from hardware.tcd1304.settings import Tcd1304Settings

RETRY_S: Final = (0.1, 0.25, 0.5, 1.0, 2.0)
"""Delays before the attempts to reconnect a lost board; the last one repeats."""


def combined_exposure_time(scans: Sequence[BoardScan]) -> tuple[int, int]:
    """Return the centre of the possible exposures, and their largest distance from it [ns].

    Boards run freely, each with its own clock, so the lines of a frame are not of one moment.
    """
    earliest = min(scan.earliest_ns for scan in scans)
    latest = max(scan.latest_ns for scan in scans)
    return (earliest + latest) // 2, (latest - earliest + 1) // 2


class Tcd1304Driver(ReportingDriver["_Run"]):
    """Requests scans from all boards in parallel, repeatedly.

    A frame is yielded when all have answered. Its sequence number counts the requests, so an
    answer that was lost or damaged leaves a gap; one that never came, of a board that is silent or
    away, leaves none. The first frame after either is flagged OVERFLOW. The boards have no clock
    to read: device time is the host's monotonic clock since ``open``.

    Args:
        name: the device's name.
        settings: the boards; see ``Tcd1304Settings``.
    """

    lossless = False

    def __init__(self, name: str, settings: Tcd1304Settings) -> None:
        super().__init__()
        self._settings = settings
        self._description = DeviceDescription(
            name=name,
            sensors=tuple(
                SensorDescription(board.name, PIXELS, PITCH_UM) for board in settings.boards
            ),
            frame_rate_hz=settings.frame_rate_hz,
            bits=BITS,
            electrons_per_count=settings.electrons_per_count,
            read_noise_electrons=settings.read_noise_electrons,
            offset_counts=settings.offset_counts,
            markers=0,
            peaks=settings.peaks,
        )

    @property
    def description(self) -> DeviceDescription:
        """The device's properties."""
        return self._description

    @property
    def exposure_uncertainty_ns(self) -> int | None:
        """Bound of the last frame's exposure time error [ns]; None: no frame yet."""
        return self._session.uncertainty_ns if self._session is not None else None

    def open(self) -> None:
        """Open all ports.

        Raises:
            DeviceNotConnected: one cannot be opened.
        """
        self.close()
        self._report.reset()
        run = self._session = _Run(self._settings)
        try:
            for board in run.boards:
                board.connect()
        except BaseException:
            run.close()
            raise

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until ``close`` is called; lost boards are reconnected.

        Raises:
            RuntimeError: the driver was never opened.
        """
        return self._frames(self._opened())

    def _frames(self, run: "_Run") -> Iterator[LineFrame]:
        sequence, failures = 0, 0
        loss = False
        lost: set[int] = set()
        with ThreadPoolExecutor(len(run.boards), "tcd1304") as pool:
            while not run.closed.is_set():
                outcomes = list(pool.map(BoardLink.ask, run.boards))
                if run.closed.is_set():
                    return
                scans = [one for one in outcomes if isinstance(one, BoardScan)]
                troubles = [one for one in outcomes if isinstance(one, BoardFault)]
                back = {i for i in lost if run.boards[i].connected}
                lost = {i for i, board in enumerate(run.boards) if not board.connected}
                self._count(outcomes, len(back))
                if not troubles:
                    failures = 0
                    self._report.set_state("connected")
                    yield self._frame(run, sequence, scans, after_loss=loss)
                    sequence += 1
                    loss = False
                    continue
                loss = True
                phase, reason = most_severe((one.phase, one.reason) for one in troubles)
                self._report.set_state(phase, f"{reason}; it is tried again")
                exposed = any(one.bytes_received for one in troubles) or bool(scans)
                sequence += exposed
                self._report.count(frames_lost=int(exposed))
                if lost:
                    run.closed.wait(RETRY_S[min(failures, len(RETRY_S) - 1)])
                    failures += 1

    def _count(self, outcomes: Sequence[BoardScan | BoardFault | None], back: int) -> None:
        received = sum(one.bytes_received for one in outcomes if one is not None)
        complete = all(isinstance(one, BoardScan) for one in outcomes)
        some = any(isinstance(one, BoardScan) for one in outcomes)
        garbled = sum(isinstance(one, BoardFault) and one.phase == "garbled" for one in outcomes)
        self._report.count(
            received_bytes=received,
            frames_received=int(complete),
            frames_garbled=garbled,
            frames_incomplete=int(some and not complete),
            reconnects=back,
        )

    def _frame(
        self, run: "_Run", sequence: int, scans: Sequence[BoardScan], *, after_loss: bool
    ) -> LineFrame:
        centre_ns, run.uncertainty_ns = combined_exposure_time(scans)
        monotonic_ns, host_ns = run.host_clock.convert(centre_ns)
        lines = np.stack(
            [dark_corrected_counts(scan.counts, self._settings.saturated_at) for scan in scans]
        )
        flags = FrameFlag.OVERFLOW if after_loss else FrameFlag.NONE
        if bool((lines == FULL_SCALE).any()):
            flags |= FrameFlag.SATURATED
        return LineFrame(
            device=self._description.name,
            sequence=sequence,
            exposure_device_ns=monotonic_ns - run.opened_ns,
            exposure_host_ns=host_ns,
            marker=None,
            lines=lines,
            flags=flags,
            host_sigma_ns=float(run.uncertainty_ns),
        )


class _Run:
    """The opened boards, from ``open`` to ``close``."""

    def __init__(self, settings: Tcd1304Settings) -> None:
        self.closed = CloseSignal()
        self.boards = [BoardLink(board, settings, self.closed) for board in settings.boards]
        self.opened_ns = time.monotonic_ns()
        self.host_clock = HostClock()
        self.uncertainty_ns: int | None = None

    def close(self) -> None:
        self.closed.set()
        for board in self.boards:
            board.close()  # waits for what `ask` does with the port, which ends at once
        self.closed.close()
