"""Simulated pixels that differ and bad pixels, with covered sensors and under even light."""

import numpy as np
from numpy.typing import NDArray

from compute.optics.profiles.profile_loader import load_profile
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.pixel_defects import PixelDefects
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import EvenLight
from hardware.simulated.settings import SimulationSettings

DEFECTS = PixelDefects(response_nonuniformity=0.03, offset_nonuniformity_counts=4.0, dead_pixels=2)


def scans(electrons: float, frames: int = 64) -> NDArray[np.float64]:
    """Counts of the simulated bar, shape (F, S, P)."""
    settings = SimulationSettings(
        EvenLight(electrons), duration_s=frames / 1000.0, pixels=DEFECTS, realtime=False
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    return np.array([frame.lines for frame in driver.frames()], dtype=np.float64)


def test_covered_and_lit_pixels_differ_as_the_settings_say() -> None:
    dark, lit = scans(0.0).mean(axis=0), scans(24_000.0).mean(axis=0)
    sensors, pixels = dark.shape
    dead, hot, stuck = DEFECTS.positions(sensors, pixels)
    good = np.ones(dark.shape, dtype=bool)
    for bad in (dead, hot, stuck):
        good[np.arange(sensors)[:, None], bad] = False
    assert dead.shape == (sensors, 2)
    assert np.unique(dead).size > 2  # not the same in all sensors
    assert abs(dark[good].mean() - 64.0) < 0.1
    assert abs(dark[good].std() / 4.0 - 1.0) < 0.05
    light = lit - dark
    assert abs(light[good].mean() - 2000.0) < 3.0
    assert abs(light[good].std() / 2000.0 / 0.03 - 1.0) < 0.05
    row = np.arange(sensors)[:, None]
    assert np.abs(light[row, dead]).max() < 3.0
    assert np.allclose(dark[row, hot], 64.0 + 250.0, atol=20.0)
    assert (lit[row, stuck] == dark[row, stuck]).all()
    assert (dark[row, stuck] == 1023.0).all()


def test_a_profile_sees_even_light_too() -> None:
    profile = load_profile("thesis-5.9")
    driver = ProfileDriver(
        "p", profile, ProfileSettings(EvenLight(0.0), duration_s=0.05, realtime=False)
    )
    driver.open()
    dark = next(driver.frames()).lines.mean()
    full = 2**profile.detector.bits - 1
    wanted = 0.4 * full * profile.detector.electrons_per_count
    lit = ProfileDriver(
        "p", profile, ProfileSettings(EvenLight(wanted), duration_s=0.05, realtime=False)
    )
    lit.open()
    assert abs(next(lit.frames()).lines.mean() - dark - 0.4 * full) < 0.02 * full
