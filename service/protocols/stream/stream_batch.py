"""What a stream may send of a batch of frames: all but the pixels."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from hardware.line_frame import FrameFlag
from service.pipeline.beam_hold_state import BeamEnableToken, BeamHoldState
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.tracking_result import TrackingResult


class FrameHeader(NamedTuple):
    """A frame without its lines; see LineFrame."""

    sequence: int
    exposure_device_ns: int
    exposure_host_ns: int
    marker: int | None
    flags: FrameFlag


@dataclass(frozen=True, eq=False)
class FlatPeaks:
    """The P peaks of the lines of some frames, line after line, without the empty places.

    Args:
        start: index of the first peak of each line, and P at the end, shape (L + 1,).
        values: position [px], sigma [px], amplitude [counts], width [px] and reduced chi-square
            of each, shape (5, P).
        flags: PeakFlag values, shape (P,).
    """

    start: NDArray[np.intp]
    values: NDArray[np.float64]
    flags: NDArray[np.int32]

    @classmethod
    def of(cls, peaks: PeakBatch) -> Self:
        """Return the peaks of a batch, copied."""
        start = np.zeros(len(peaks.count) + 1, dtype=np.intp)
        np.cumsum(peaks.count, out=start[1:])
        there = np.arange(peaks.position_px.shape[1]) < peaks.count[:, None]
        values = np.stack(
            [
                column[there]
                for column in (
                    peaks.position_px,
                    peaks.sigma_px,
                    peaks.amplitude,
                    peaks.width_px,
                    peaks.reduced_chi2,
                )
            ]
        )
        return cls(start, values.astype(np.float64, copy=False), peaks.flags[there])


@dataclass(frozen=True, eq=False)
class StreamBatch:
    """Frames of one device as the streams keep them; the members are those of FrameBatch.

    Args:
        releases: of all holds that say that a beam is not held, each once.
    """

    device_id: str
    sensor_names: tuple[str, ...]
    calibration_id: str | None
    table_id: str | None
    frames: tuple[FrameHeader, ...]
    peaks: FlatPeaks
    points: PointBatch
    owner: NDArray[np.intp]
    motion: TrackingResult | None = None
    holds: tuple[tuple[BeamHoldState, ...], ...] = ()
    releases: tuple[BeamEnableToken, ...] = ()

    @classmethod
    def of(cls, batch: FrameBatch) -> Self:
        """Return what is kept of a batch; nothing in it holds on to the lines."""
        frames = tuple(
            FrameHeader(
                frame.sequence,
                frame.exposure_device_ns,
                frame.exposure_host_ns,
                frame.marker,
                frame.flags,
            )
            for frame in batch.frames
        )
        return cls(
            batch.device_id,
            batch.sensor_names,
            batch.calibration_id,
            batch.table_id,
            frames,
            FlatPeaks.of(batch.peaks),
            batch.points,
            batch.owner,
            batch.motion,
            batch.holds,
            tuple({now.release for after in batch.holds for now in after if now.release}),
        )
