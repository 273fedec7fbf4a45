"""FrameBlock: consecutive frames and their results as arrays."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.recording.layout import FRAME, NO_CALIBRATION_ROW, NO_MARKER


def scan_shape(description: DeviceDescription) -> tuple[int, int]:
    """Return the number of sensors and of pixels per sensor.

    Raises:
        InvalidParameter: there is no sensor, or they are of different lengths.
    """
    pixels = {sensor.pixels for sensor in description.sensors}
    if len(pixels) != 1 or min(pixels) < 1:
        raise InvalidParameter(
            f"the sensors have {sorted(pixels)} pixels; a recording needs at least one sensor, "
            "all of them of one length",
            pixels=sorted(pixels),
        )
    return len(description.sensors), pixels.pop()


def frame_rows(frames: Iterable[LineFrame]) -> NDArray[np.void]:
    """Return the metadata of frames as rows of FRAME, without results."""
    return np.array(
        [
            (
                frame.sequence,
                frame.exposure_device_ns,
                frame.exposure_host_ns,
                NO_MARKER if frame.marker is None else frame.marker,
                int(frame.flags),
                NO_CALIBRATION_ROW,
                0,
                0,
            )
            for frame in frames
        ],
        FRAME,
    )


@dataclass(frozen=True, eq=False)
class FrameBlock:
    """Consecutive frames with their scans, peaks and points.

    Args:
        rows: of FRAME, shape (F,), in the order of their exposure.
        lines: uint16, shape (F, S, P); None in a recording of results only.
        peaks: of PEAK, the peaks of all frames in order; ``frame`` counts within the block.
        points: of ``point_dtype``, in the same way.
    """

    rows: NDArray[np.void]
    lines: NDArray[np.uint16] | None
    peaks: NDArray[np.void]
    points: NDArray[np.void]

    def select(self, mask: NDArray[np.bool_]) -> "FrameBlock":
        """Return the block of the frames where ``mask``, shape (F,), holds."""
        index = np.cumsum(mask) - 1

        def select_results(results: NDArray[np.void]) -> NDArray[np.void]:
            selected: NDArray[np.void] = results[mask[results["frame"]]].copy()
            selected["frame"] = index[selected["frame"]]
            return selected

        lines = None if self.lines is None else self.lines[mask]
        return FrameBlock(
            self.rows[mask], lines, select_results(self.peaks), select_results(self.points)
        )
