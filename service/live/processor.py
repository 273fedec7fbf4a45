"""Frames of one device to peaks and points, with the calibration in force."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.calibration.weights import reading_sigma
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.reconstruction.correspondence import match_peaks
from compute.reconstruction.estimate import PointBatch, PointFlag
from compute.reconstruction.points import reconstruct
from compute.signal.finder import CentroidFinder
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch, PeakFlag, no_peaks
from compute.signal.settings import CentroidSettings
from hardware.driver import DeviceDescription
from hardware.frame import LineFrame
from service.live.batch import FrameBatch

Array = NDArray[np.float64]

MAX_FRAMES = 64
"""Frames that are processed together, at most, when they have piled up."""


@dataclass(frozen=True, eq=False)
class _Active:
    """A calibration in the form that the live path uses."""

    calibration_id: str
    calibration: Calibration
    cameras: CameraStack
    covariance: Array


class DeviceProcessor:
    """Pure function of frames and calibration, with the buffers that it needs.

    Made and called in the compute thread; ``set_calibration`` may be called from any thread and
    takes effect between two batches.
    """

    def __init__(
        self, device_id: str, description: DeviceDescription, compute_device: str | None = None
    ) -> None:
        """Load Warp and allocate the kernel's buffers; ``compute_device`` as in CentroidFinder."""
        self._device_id = device_id
        self._names = tuple(sensor.name for sensor in description.sensors)
        self._active: _Active | None = None
        self._finder: CentroidFinder | None = None
        if description.readout != "lines":
            return  # nothing to find: a shadow or tracks have no peaks
        self._finder = CentroidFinder(
            lines=len(description.sensors) * MAX_FRAMES,
            pixels=description.sensors[0].pixels,
            settings=CentroidSettings(),
            noise=LineNoise.of(
                [description.electrons_per_count] * len(self._names),
                description.read_noise_electrons,
                description.offset_counts,
                2**description.bits - 1,
            ),
            device=compute_device,
        )
        # Loads the kernel and touches the buffers, before the first frame waits for it.
        self._finder.find(np.zeros((len(self._names), description.sensors[0].pixels), np.uint16))

    @property
    def calibration_id(self) -> str | None:
        """The calibration in force."""
        active = self._active
        return active.calibration_id if active else None

    def set_calibration(self, calibration_id: str | None, calibration: Calibration | None) -> None:
        """Switch the calibration; one assignment, so that a batch sees the old or the new.

        Raises:
            InvalidParameter: the calibration is of other sensors.
        """
        if calibration_id is None or calibration is None:
            self._active = None
            return
        names = tuple(model.name for model in calibration.models)
        if names != self._names:
            raise InvalidParameter(
                f"calibration {calibration_id} is of the sensors {', '.join(names)}; the device "
                f"has {', '.join(self._names)}"
            )
        self._active = _Active(
            calibration_id,
            calibration,
            CameraStack.of(calibration.models),
            np.array(calibration.covariance),
        )

    def process(self, frames: Sequence[LineFrame]) -> FrameBatch:
        """Find the peaks of up to MAX_FRAMES frames and reconstruct their points.

        A device whose lines do not show markers as lines of light gives neither.
        """
        active = self._active
        if len(frames) == 1:
            lines = frames[0].lines
        else:
            lines = np.concatenate([frame.lines for frame in frames])
        sensors = len(self._names)
        peaks = no_peaks(len(lines)) if self._finder is None else self._finder.find(lines)
        if active is None or self._finder is None:
            points, owner = _no_points(sensors), np.empty(0, dtype=np.intp)
        else:
            points, owner = _reconstruct(active, frames, peaks, sensors)
        return FrameBatch(
            self._device_id,
            self._names,
            active.calibration_id if active else None,
            tuple(frames),
            peaks,
            points,
            owner,
        )


def _no_points(sensors: int) -> PointBatch:
    return PointBatch(
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty(0),
        np.empty((0, sensors), dtype=np.bool_),
        np.empty(0, dtype=np.int32),
    )


def _reconstruct(
    active: _Active, frames: Sequence[LineFrame], peaks: PeakBatch, sensors: int
) -> tuple[PointBatch, NDArray[np.intp]]:
    """Return the points of all frames and the frame that each belongs to."""
    shape = (len(frames), sensors, -1)
    position = peaks.position_px.reshape(shape).astype(np.float64)
    flags = np.where(np.isfinite(position), peaks.flags.reshape(shape), 0)
    # A line that runs over the sensor's end is drawn inwards by far more than its noise: not seen.
    position[(flags & PeakFlag.CLIPPED) != 0] = np.nan
    doubtful = position[(flags & (PeakFlag.SATURATED | PeakFlag.MERGED)) != 0]
    # By frame, peak and sensor for the calibration's figures, which are by sensor.
    own = peaks.sigma_px.reshape(shape).astype(np.float64).transpose(0, 2, 1)
    spread = reading_sigma(active.calibration, own, own).transpose(0, 2, 1)
    amplitude = peaks.amplitude.reshape(shape)
    rows: list[Array] = []
    sigmas: list[Array] = []
    owner: list[int] = []
    ambiguous: list[bool] = []
    # A strobed exposure shows one marker: the brightest peak is it, weaker ones are reflections.
    brightest = np.where(np.isfinite(position), amplitude, -1.0).argmax(axis=2)[..., None]
    strobed = np.take_along_axis(position, brightest, axis=2)[..., 0]
    strobed_sigma = np.take_along_axis(spread, brightest, axis=2)[..., 0]
    for index, frame in enumerate(frames):
        if frame.marker is not None:
            rows.append(strobed[index])
            sigmas.append(strobed_sigma[index])
            owner.append(index)
            ambiguous.append(False)
            continue
        found = match_peaks(active.cameras, position[index], spread[index], active.covariance)
        rows.extend(found.readings_px)
        sigmas.extend(found.sigma_px)
        owner.extend([index] * len(found.readings_px))
        ambiguous.extend(found.ambiguous.tolist())
    if not rows:
        return _no_points(sensors), np.empty(0, dtype=np.intp)
    readings, deviations = np.array(rows), np.array(sigmas)
    points = reconstruct(active.cameras, readings, deviations, active.covariance)
    found_flags = np.where(ambiguous, int(PointFlag.AMBIGUOUS), 0)
    from_doubtful = np.isin(readings, doubtful).any(axis=1)
    found_flags |= np.where(from_doubtful, int(PointFlag.DOUBTFUL_PEAK), 0)
    points = replace(points, flags=(points.flags | found_flags).astype(np.int32))
    return points, np.array(owner, dtype=np.intp)
