"""What the compute thread makes of a batch of frames: peaks, points, and who they belong to."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame
from service.pipeline.beam_hold_state import BeamHoldState
from service.pipeline.tracking_result import TrackingResult


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames of one device, processed together.

    Args:
        device_id: the device.
        sensor_names: its sensors in order.
        calibration_id: the calibration of these points; None: there are no points.
        table_id: the correction table of these points; None: readings were not corrected.
        frames: F frames in the order of their exposure.
        peaks: peaks of the F x S lines, frame by frame.
        points: N points of all frames.
        owner: index of the frame of each point, ascending, shape (N,).
        motion: tracks and tool poses; None: the device is not tracked.
        holds: the device's beam holds after each frame; empty: it has none.
    """

    device_id: str
    sensor_names: tuple[str, ...]
    calibration_id: str | None
    table_id: str | None
    frames: tuple[LineFrame, ...]
    peaks: PeakBatch
    points: PointBatch
    owner: NDArray[np.intp]
    motion: TrackingResult | None = None
    holds: tuple[tuple[BeamHoldState, ...], ...] = ()
