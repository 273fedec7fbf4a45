"""The Optotrak profile, calibrated and mapped, at its published noise."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.profiles.profile_loader import load_profile
from compute.planning.coverage import is_visible
from validation.map_bound.point_errors import fit, mapped, noise_bound, point_errors
from validation.map_bound.scene import Readings, Scene, random_points_in_box
from validation.result_tables import Cell, ResultTable

Array = NDArray[np.float64]

DISTANCE_MM: Final = 2250.0
RESOLUTION_MM: Final = 0.01
"""Northern Digital, specification of the Optotrak 3020, at 2.25 m."""
ACROSS_MM: Final = 0.1
DEPTH_MM: Final = 0.15
"""Accuracy that was published there."""
CONTROL: Final = 300
TEST: Final = 1000
_BLOCK: Final = 128


def optotrak_table(control: int = CONTROL, test: int = TEST) -> tuple[ResultTable, str]:
    """Return RMS errors over the profile's volume and in the section at 2.25 m, and a finding."""
    profile = load_profile("optotrak")
    scene = Scene.of(profile)
    centre, size = np.array(profile.volume.centre_mm), np.array(profile.volume.size_mm)
    low, high = centre - size / 2.0, centre + size / 2.0
    rng = np.random.default_rng(4)
    scale = fit_scale(scene, low, high)
    sigma = RESOLUTION_MM * scale
    positions = random_points_in_box(control * 3 // 2, low, high, 5)
    known = _seen(scene, positions, sigma, rng)
    known = known.of(np.flatnonzero(known.sensors == 3)[:control])
    one = fit(known, scene.geometry, "auto")
    both = mapped(one, known)

    flat_low, flat_high = low.copy(), high.copy()
    flat_low[2], flat_high[2] = DISTANCE_MM - 1.0, DISTANCE_MM + 1.0
    rows: list[tuple[Cell, ...]] = []
    worst = np.zeros(2)
    for label, box in (("whole volume", (low, high)), ("2.25 m", (flat_low, flat_high))):
        points = np.random.default_rng(6).uniform(*box, (test * 3 // 2, 3))
        found = _seen(scene, points, sigma, rng)
        found = found.of(np.flatnonzero(found.sensors == 3)[:test])
        bound = noise_bound(one.cameras, found)
        for name, what in (("terms in u and v", one), ("terms in u and v, map", both)):
            errors = point_errors(what, found, bound)
            rms = np.sqrt((errors.difference_mm**2).mean(axis=0))
            if what is both and label == "2.25 m":
                worst = np.array([rms[:2].max(), rms[2]])
            every = np.ones(len(bound), dtype=np.bool_)
            least = np.sqrt(bound[:, range(3), range(3)].mean(axis=0))
            rows.append(
                (
                    label,
                    name,
                    len(bound),
                    *(float(f"{value:.3g}") for value in (*rms, *least)),
                    float(f"{errors.rms_mm(every) / errors.bound_rms_mm(every):.4g}"),
                    float(f"{errors.mean_square(every):.3g}"),
                )
            )
    headings = ("points", "camera", "number", "X", "Y", "Z", "bound X", "Y ", "Z ", "over bound")
    table = ResultTable(
        f"the Optotrak's profile, {control} control points, at its published noise, RMS [mm]",
        (*headings, "error squared"),
        tuple(rows),
    )
    return table, (
        f"The Optotrak's three sensors at {RESOLUTION_MM:g} mm of noise across at 2.25 m "
        f"({sigma:.3f} px): {worst[0]:.3f} mm RMS across and {worst[1]:.3f} mm in depth there; "
        f"{ACROSS_MM:g} and {DEPTH_MM:g} mm were published."
    )


def fit_scale(scene: Scene, low_mm: Array, high_mm: Array) -> float:
    """Return how many pixels a millimetre across is in the middle of the volume [px/mm]."""
    centre = 0.5 * (low_mm + high_mm)
    device = scene.device
    steps = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    readings = device.image_points(centre + steps).readings_px
    return float(np.abs(readings[1] - readings[0]).mean())


def _seen(scene: Scene, points_mm: Array, sigma_px: float, rng: np.random.Generator) -> Readings:
    """Trace points and give their readings the noise."""
    device = scene.device
    exact = []
    for start in range(0, len(points_mm), _BLOCK):
        look = device.image_points(points_mm[start : start + _BLOCK])
        sees = is_visible(look.readings_px, device.pixels, look.light_sr)
        exact.append(np.where(sees, look.readings_px, np.nan))
    found = np.concatenate(exact)
    sigma = np.where(np.isfinite(found), sigma_px, np.nan)
    return Readings(points_mm, found, found, sigma, sigma).drawn(rng)
