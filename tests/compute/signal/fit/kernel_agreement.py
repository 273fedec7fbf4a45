"""Settings and shapes of every kind, and what agreement of two batches of fitted peaks means."""

from dataclasses import replace

import numpy as np

from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise

SETTINGS = {
    "fitted width": FitSettings(),
    "known width": FitSettings(width_log_sigma=0.0),
    "free width, slope": FitSettings(width_log_sigma=np.inf, background="slope"),
    "shape error": FitSettings(shape_error=0.02, reach=3.0),
    "one by one": FitSettings(max_joint_peaks=1, false_split_rate=0.01),
    "no further peaks": FitSettings(further_peaks=False),
    "no further peaks, free width": FitSettings(width_log_sigma=np.inf, further_peaks=False),
    "little room": FitSettings(search=CentroidSettings(max_peaks=3), width_log_sigma=2.0),
}


def any_shape(rng: np.random.Generator) -> LineSpreadFunction:
    """Measured shapes of some sensors and nodes, of about 0.6 to 1.2 px, skewed by place."""
    sensors, nodes, cells = (int(rng.integers(1, high)) for high in (5, 5, 200))
    cells += 20
    x = np.linspace(-5.0, 5.0, cells)
    middle = rng.normal(0.0, 0.3, (sensors, nodes, 1))
    width = rng.uniform(0.6, 1.2, (sensors, nodes, 1)) * np.where(x < middle, 1.0, 1.3)
    light = np.exp(-0.5 * ((x - middle) / width) ** 2)
    first_node, node_step = float(rng.uniform(-100, 600)), float(rng.uniform(10, 600))
    return LineSpreadFunction.from_cells(light, -5.0, 10.0 / cells, first_node, node_step)


def any_settings(rng: np.random.Generator) -> FitSettings:
    """Settings from all over their ranges."""
    search = CentroidSettings(
        threshold_fraction=float(rng.choice([1 / 3, 0.05, 0.2, 0.5, 0.95])),
        detection_sigma=float(rng.choice([3.0, 6.0, 20.0])),
        min_width_px=int(rng.integers(1, 4)),
        weighting=["edge-corrected", "above-threshold", "above-background"][rng.integers(3)],
        max_peaks=int(rng.integers(1, 24)),
    )
    return FitSettings(
        search=search,
        width_px=float(rng.uniform(0.25, 8.0)),
        width_log_sigma=float(rng.choice([0.0, 0.1, 0.5, 2.0, np.inf])),
        reach=float(rng.uniform(2.0, 8.0)),
        background=["level", "slope"][rng.integers(2)],
        shape_error=float(rng.choice([0.0, 0.01, 0.1])),
        max_joint_peaks=int(rng.integers(1, 5)),
        false_split_rate=float(rng.choice([1e-12, 1e-4, 0.1])),
    )


def any_noise(rng: np.random.Generator) -> SensorNoise:
    """Noise of three sensors, quiet or loud."""
    return SensorNoise.of(
        rng.uniform(0.1, 100.0, 3),
        rng.uniform(0.0, 100.0, 3),
        rng.uniform(-100.0, 2000.0),
        int(rng.choice([255, 4095, 65535])),
    )


def lines_that_differ(found: PeakBatch, expected: PeakBatch, part: float = 1e-3) -> np.ndarray:
    """Say which lines have other peaks or flags, or figures that are off.

    Positions by more than ``part`` of their standard deviation, deviations, amplitudes and widths
    by more than ``part`` of themselves, covariances by that of the variances, the reduced
    chi-square by as much as that moves it.
    """
    differ = (found.count != expected.count) | (found.flags != expected.flags).any(axis=1)
    sigma = expected.sigma_px.astype(np.float64)
    off = np.abs(found.position_px - expected.position_px) > part * sigma
    for name in ("sigma_px", "amplitude", "width_px"):
        value = getattr(expected, name)
        off |= np.abs(getattr(found, name) - value) > part * np.abs(value)
    chi2 = expected.reduced_chi2
    off |= np.abs(found.reduced_chi2 - chi2) > part * (1.0 + chi2)
    for name in ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2"):
        off |= np.isnan(getattr(found, name)) != np.isnan(getattr(expected, name))
    covariance = np.abs(found.covariance_px2 - expected.covariance_px2).max(axis=2)
    off |= covariance > part * sigma**2
    return differ | off.any(axis=1)


def without_room(settings: FitSettings, max_peaks: int) -> FitSettings:
    """The settings with room for fewer peaks."""
    return replace(settings, search=replace(settings.search, max_peaks=max_peaks))
