"""Batches of a waved wand whose two ends are lit in turn, as the simulated sensors see it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch, PeakFlag
from hardware.line_frame import LineFrame
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.pipeline.frame_batch import FrameBatch

Array = NDArray[np.float64]

MODELS = simulated_sensor_models()
NAMES = tuple(model.name for model in MODELS)
LENGTH_MM = 300.0
SIGMA_PX = 0.03
RATE_HZ = 250
BATCH = 50
CENTRE_MM = np.array([0.0, 0.0, 1500.0])


def ends_mm(time_s: Array, tilt: float = 1.4) -> Array:
    """Ends of a wand that swings through a volume of 560 mm, shape (N, 2, 3).

    Args:
        time_s: shape (N,).
        tilt: how far the wand tilts out of the plane across the view [rad].
    """
    swings = np.sin(2.0 * np.pi * time_s[:, None] * [0.171, 0.137, 0.109] + [0.0, 1.0, 2.0])
    polar = tilt * np.sin(2.0 * np.pi * 0.123 * time_s)
    azimuth = 2.0 * np.pi * 0.19 * time_s
    along = np.stack(
        [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), np.sin(polar)], axis=1
    )
    middle = CENTRE_MM + 280.0 * swings
    half = 0.5 * LENGTH_MM * along
    return np.stack([middle - half, middle + half], axis=1)


def waved(
    seconds: float,
    *,
    start_s: float = 0.0,
    tilt: float = 1.4,
    change: Callable[[PeakBatch], None] = lambda peaks: None,
) -> list[FrameBatch]:
    """Batches of a wave, exposure by exposure, each with one end lit.

    Args:
        seconds: how long it is waved.
        start_s: when that begins in the motion.
        tilt: see ``ends_mm``.
        change: changes the peaks of a batch.
    """
    rng = np.random.default_rng(1)
    every = np.arange(round(start_s * RATE_HZ), round((start_s + seconds) * RATE_HZ))
    found = []
    for sequence in np.split(every, np.arange(BATCH, len(every), BATCH)):
        count = len(sequence)
        lit = ends_mm(sequence / RATE_HZ, tilt)[np.arange(count), sequence % 2]
        read = CameraStack.of(MODELS).project(lit) + SIGMA_PX * rng.standard_normal((count, 4))
        inside = ((read > -0.5) & (read < MODELS[0].pixels - 0.5)).ravel()
        peaks = PeakBatch.empty(4 * count, 2)
        # A weak reflection, which is not the marker, before each peak.
        both = np.stack([np.full(4 * count, 3.0), read.ravel()], axis=1)
        peaks.position_px[:] = np.where(inside[:, None], both, np.nan)
        peaks.sigma_px[:] = [0.5, SIGMA_PX]
        peaks.amplitude[:] = [20.0, 900.0]
        change(peaks)
        dark = np.zeros((4, 8), np.uint16)
        frames = tuple(
            LineFrame("sim", n, n * 10**9 // RATE_HZ, n * 10**9 // RATE_HZ, n % 2, dark)
            for n in sequence.tolist()
        )
        points, owner = PointBatch.empty(4), np.empty(0, dtype=np.intp)
        found.append(FrameBatch("sim", NAMES, "sim-nominal", None, frames, peaks, points, owner))
    return found


def saturate(peaks: PeakBatch) -> None:
    """Saturate the brightest peaks of the first sensor."""
    peaks.flags[::4, 1] = int(PeakFlag.SATURATED)
