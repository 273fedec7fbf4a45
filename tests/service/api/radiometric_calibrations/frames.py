"""Frames of the simulated bar, covered and under even light."""

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import no_peaks
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.pixel_defects import PixelDefects
from hardware.simulated.scenes import EvenLight
from hardware.simulated.settings import SimulationSettings
from service.pipeline.frame_batch import FrameBatch

DEFECTS = PixelDefects(response_nonuniformity=0.02, offset_nonuniformity_counts=3.0)


def driver(electrons: float, frames: int, seed: int = 1) -> SimulatedDriver:
    """A simulated bar with pixels that differ, under even light."""
    settings = SimulationSettings(
        EvenLight(electrons),
        duration_s=frames / 1000.0,
        pixels=DEFECTS,
        realtime=False,
        seed=seed,
    )
    return SimulatedDriver("sim", settings)


def description() -> DeviceDescription:
    """What it says of itself."""
    return driver(0.0, 1).description


def frames_of(electrons: float, frames: int, seed: int = 1) -> list[LineFrame]:
    """Its frames under even light."""
    source = driver(electrons, frames, seed)
    source.open()
    return list(source.frames())


def batch_of(frames: list[LineFrame]) -> FrameBatch:
    """A batch without peaks."""
    names = tuple(sensor.name for sensor in description().sensors)
    points = PointBatch.empty(len(names))
    owner = np.empty(0, dtype=np.intp)
    peaks = no_peaks(len(frames) * len(names))
    return FrameBatch("sim", names, None, None, tuple(frames), peaks, points, owner)


def lit(electrons: float, frames: int = 32, seed: int = 1) -> list[FrameBatch]:
    """Batches of frames under even light."""
    return [batch_of(frames_of(electrons, frames, seed))]


def scans_of(electrons: float, frames: int, sensor: int, seed: int = 1) -> NDArray[np.uint16]:
    """Scans of one sensor, shape (F, P)."""
    return np.array([frame.lines[sensor] for frame in frames_of(electrons, frames, seed)])
