"""Newest scans of a running device: pixels, levels, peaks, and fits by the device's own method."""

from collections.abc import Sequence
from threading import Event
from typing import Annotated, Final

import numpy as np
from fastapi import Query
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_reference import scan_background
from compute.signal.centroid_settings import LEVEL_UNIT
from compute.signal.fit.group_fit import fit_scan
from hardware.line_frame import LineFrame
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.line_scans.peak_search import fit_windows, line_peaks
from service.api.line_scans.schema import DeviceScan, DeviceScans, LinePeak
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import SearchModel
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect
from service.problems.errors import DeviceNotRunning

TIMEOUT_S: Final = 5.0
"""How long the next exposure is waited for: a device that nobody watched takes a moment."""
MAX_CONCURRENT: Final = 8

_limit = ConcurrencyLimit(
    MAX_CONCURRENT,
    f"{MAX_CONCURRENT} requests wait for scans already; send this one again in a second",
)

AfterQuery = Annotated[
    int | None,
    Query(ge=0, description="Wait for an exposure behind this sequence number.", examples=[1234]),
]
MarkerQuery = Annotated[
    int | None,
    Query(
        ge=0,
        le=10_000,
        description="Wait for an exposure of this strobed marker; left out: any exposure.",
    ),
]
DetailQuery = Annotated[
    str | None,
    Query(
        max_length=100,
        description="Name of the sensor whose fits are told, too: model and residuals.",
    ),
]


class ScanTap:
    """Takes the newest wanted exposure of one batch, and no other."""

    wants_pixels: Final = True

    def __init__(self, after_sequence: int | None, marker: int | None) -> None:
        self._after = after_sequence
        self._marker = marker
        self.found: tuple[FrameBatch, int] | None = None
        """The batch, and the index of the exposure in it."""
        self.ended = Event()
        """Set when it is there."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: scans and peaks do not depend on it."""

    def offer(self, batch: FrameBatch) -> None:
        """Take the newest exposure that is wanted; called where frames are processed."""
        if self.found is not None:
            return
        for index in range(len(batch.frames) - 1, -1, -1):
            if self._wants(batch.frames[index]):
                self.found = batch, index
                self.ended.set()
                return

    def _wants(self, frame: LineFrame) -> bool:
        if self._marker is not None and frame.marker != self._marker:
            return False
        return self._after is None or frame.sequence > self._after


def live_scans(
    live: Pipeline,
    device_id: str,
    after: int | None,
    marker: int | None,
    detail_sensor: str | None,
) -> DeviceScans:
    """Wait for an exposure of a running device, and return its scans.

    Raises:
        DeviceNotRunning: it does not run, ends meanwhile, or made no such exposure in TIMEOUT_S.
        InvalidParameter: it has no such sensor, or is fused and has no scans.
        Busy: too many wait already.
    """
    session = live.session(device_id)
    if session.description.readout == "bar-peaks":
        raise InvalidParameter(
            f'device "{device_id}" is fused, and has no scans; look at those of its bars',
            device_id=device_id,
        )
    names = [sensor.name for sensor in session.description.sensors]
    check_sensor(detail_sensor, names)
    tap = ScanTap(after, marker)
    with _limit:
        collect(live, session, tap, TIMEOUT_S, tap.ended)
        if tap.found is None:
            of = "" if marker is None else f" of marker {marker}"
            raise DeviceNotRunning(
                f'device "{device_id}" made no exposure{of} in {TIMEOUT_S:g} s; is it lit and '
                "triggered?",
                device_id=device_id,
            )
        batch, index = tap.found
        frame, model = batch.frames[index], session.search_model
        return DeviceScans(
            device_id=device_id,
            sequence=frame.sequence,
            exposure_ns=frame.exposure_host_ns,
            marker=frame.marker,
            method=session.method,
            radiometric_id=batch.radiometric_id,
            scans=[
                describe_scan(
                    name,
                    sensor,
                    frame.lines[sensor],
                    line_peaks(batch.peaks, index * len(names) + sensor),
                    model,
                    detail=name == detail_sensor,
                )
                for sensor, name in enumerate(names)
            ],
        )


def check_sensor(name: str | None, names: Sequence[str]) -> None:
    """Raise InvalidParameter where the sensor whose detail is asked for is none of these."""
    if name is not None and name not in names:
        raise InvalidParameter(f'detail_sensor is "{name}"; the device has {", ".join(names)}')


def describe_scan(
    name: str,
    sensor: int,
    counts: NDArray[np.uint16],
    peaks: list[LinePeak],
    model: SearchModel,
    *,
    detail: bool,
) -> DeviceScan:
    """Return a scan with its levels and, where asked for, its fits.

    Args:
        name: of the sensor.
        sensor: its number.
        counts: shape (P,).
        peaks: that were found in it.
        model: what they were found with.
        detail: whether fits are wanted.
    """
    background, noise, threshold = _levels(counts, sensor, model)
    full_scale = int(model.noise.full_scale_counts[sensor])
    corrections = model.corrections
    masked = [] if corrections is None else np.flatnonzero(corrections.masked[sensor]).tolist()
    windows = None
    if detail and model.fit is not None:
        # By the definition, which the kernel that made the peaks agrees with.
        windows = fit_windows(
            fit_scan(counts, model.fit, model.noise, model.shape, sensor, corrections)
        )
    return DeviceScan(
        sensor=name,
        counts=counts.tolist(),
        background_counts=background,
        noise_counts=noise,
        threshold_counts=threshold,
        full_scale_counts=full_scale,
        saturated_pixels=int(np.count_nonzero(counts >= full_scale)),
        masked_pixels=masked,
        peaks=peaks,
        windows=windows,
    )


def _levels(
    counts: NDArray[np.uint16], sensor: int, model: SearchModel
) -> tuple[float, float, float | None]:
    """Return background, noise there, and what a peak's highest pixel must reach [counts]."""
    shifts = None
    if model.corrections is not None:
        shifts = model.corrections.group_shifts()[sensor].astype(np.int64)
    level, spread, _ = scan_background(counts.astype(np.int64), shifts)
    background, scatter = level / LEVEL_UNIT, spread / LEVEL_UNIT
    light = max(background - float(model.noise.offset_counts[sensor]), 0.0)
    variance = model.noise.dark_variance[sensor] + model.noise.photon_variance[sensor] * light
    sigma = float(np.sqrt(variance))
    if model.search is None:
        return background, sigma, None
    return background, sigma, background + model.search.detection_sigma * max(sigma, scatter)
