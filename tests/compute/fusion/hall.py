"""The hall of the oracle, as the project sees it, and its fused points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.fusion.alignment import align
from compute.fusion.clock_errors import PointReadings, clock_sensitivity, correct_points
from compute.fusion.clock_refinement import ClockRefinement
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from tests.compute.rig import camera
from tests.oracles.two_bars import CENTRE, LAYOUT, HallRun

Array = NDArray[np.float64]

SIGMA_PX = 0.05
BAR = np.array([-1] * 4 + [0] * 4)


def model() -> MeasurementModel:
    """The eight cameras, exactly known."""
    cameras = [
        camera(f"s{number}", np.array(position), float(angle), CENTRE)
        for number, (position, angle) in enumerate(LAYOUT)
    ]
    return MeasurementModel(CameraStack.of(cameras))


@dataclass(frozen=True)
class Aligned:
    """Readings of both bars at the first one's exposures.

    Args:
        kept: which exposures have all, shape (N,).
        readings: of these.
    """

    kept: NDArray[np.bool_]
    readings: PointReadings


def align_run(run: HallRun, applied_s: float = 0.0) -> Aligned:
    """Bring the second bar's readings to the first one's exposures."""
    count = len(run.time_s)
    found = np.full((5, count, 4), np.nan)
    stated = run.second_stated_s - applied_s
    for k, at in enumerate(run.time_s):
        near = int(np.argmin(np.abs(stated - at)))
        if not 1 <= near <= count - 2:
            continue
        three = slice(near - 1, near + 2)
        raw = run.second_px[three, :, None]
        one = align(tuple(stated[three] - at), raw, np.full(raw.shape, SIGMA_PX**2))
        found[:, k] = np.stack([*vars(one).values()])[..., 0]
    kept = np.isfinite(found).all(axis=(0, 2))
    found[1] = np.sqrt(found[1])
    none = np.zeros(run.first_px.shape)
    of_first = (run.first_px, none + SIGMA_PX, none, none, none)
    readings = PointReadings(*(np.hstack(pair)[kept] for pair in zip(of_first, found, strict=True)))
    return Aligned(kept, readings)


def fuse(run: HallRun, clock_sigma_s: float) -> tuple[NDArray[np.bool_], PointBatch, PointBatch]:
    """Return which exposures count, and their points without and with the clock's uncertainty."""
    aligned = align_run(run)
    cameras = model()
    readings = aligned.readings
    points = reconstruct(cameras.cameras, readings.position_px, readings.sigma_px)
    sensitivity = clock_sensitivity(cameras, points, readings, BAR)
    grown = correct_points(points, sensitivity, np.zeros(1), np.array([[clock_sigma_s**2]]))
    return aligned.kept, points, grown


def refine(run: HallRun, clock_sigma_s: float) -> ClockRefinement:
    """Return the clock as a run has refined it."""
    aligned = align_run(run)
    cameras = model()
    points = reconstruct(cameras.cameras, aligned.readings.position_px, aligned.readings.sigma_px)
    sensitivity = clock_sensitivity(cameras, points, aligned.readings, BAR, with_common_errors=True)
    clock = ClockRefinement(np.array([clock_sigma_s]))
    clock.update(sensitivity, np.zeros(1))
    return clock
