"""Interface of the peak finders: batches of scans in, batches of peaks out, on one device."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from compute.signal.peaks import PeakBatch

if TYPE_CHECKING:
    from compute.signal.native.kernel_runner import ScanKernelRunner


class PeakFinder(ABC):
    """A compiled kernel with its buffers; its records become peaks.

    Args:
        runner: runs the kernel.
    """

    def __init__(self, runner: "ScanKernelRunner") -> None:
        self._runner = runner

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._runner.device

    def find(self, scans: NDArray[np.uint16]) -> PeakBatch:
        """Find the peaks of scans, uint16, shape (L, P), L at most the finder's ``lines``.

        Only the returned arrays are allocated (and a copy, where the rows do not lie one after
        another in memory).

        Raises:
            InvalidParameter: another type or shape.
        """
        return self._collect(self._runner.find(scans))

    def upload(self, scans: NDArray[np.uint16]) -> None:
        """Copy scans to the device; on the CPU they stay where they are, until ``launch``.

        ``find`` is upload, launch and download; apart, they time the kernel alone.
        """
        self._runner.upload(scans)

    def launch(self, count: int) -> None:
        """Start the kernel on the first ``count`` of the uploaded scans.

        Raises:
            InvalidParameter: there are fewer.
        """
        self._runner.launch(count)

    def download(self, count: int) -> PeakBatch:
        """Wait for the kernel and return the peaks of the first ``count`` scans."""
        return self._collect(self._runner.download(count))

    @abstractmethod
    def _collect(self, records: NDArray[np.void]) -> PeakBatch:
        """Return the peaks of scans' records, which stand only until the next call."""
