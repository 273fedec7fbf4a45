"""Robust fit of a sensor's lens distortion for the search of label errors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.evaluation import SensorReadings
from compute.calibration.mislabels.hypothesis import Hypothesis
from compute.calibration.settings import Preset, preset_terms
from compute.calibration.single_sensor.distorted_fit import fit_distorted
from compute.calibration.single_sensor.sensor_fits import ControlObservations
from compute.calibration.single_sensor.undistorted_fit import fit_undistorted
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, LumilineError, NoConvergence, TooFewPoints
from compute.robust_statistics import BIWEIGHT_LIMIT, mad_sigma

Array = NDArray[np.float64]

CANDIDATES: Final[tuple[Preset, ...]] = ("symmetric-3", "all-3", "symmetric-5", "all-5")
"""Sets of distortion terms that are tried, in the order of their size."""
READINGS_EACH: Final = 2
"""Smallest number of readings for each parameter to try a lens."""
NOT_FITTED: Final[tuple[type[LumilineError], ...]] = (
    DegeneratePoints,
    NoConvergence,
    TooFewPoints,
)


@dataclass(frozen=True, eq=False)
class _RobustFit:
    """A robust fit of one camera: its normalised residuals (n,) and parameters."""

    model: SensorModel
    off: Array
    parameters: int


def with_lens(
    data: SensorReadings, label_errors: Hypothesis | None = None
) -> SensorReadings | None:
    """Return readings with the lens distortion of a robust fit of them.

    Of the lenses with ``READINGS_EACH`` readings a parameter the one with the lowest bounded
    squares is taken, each parameter costing the logarithm of the readings (Schwarz's criterion,
    doi:10.1214/aos/1176344136). The field angles u, v are the fit's; the coefficients stay free
    in the search, by which a reading that bends the lens towards itself is seen to do so.

    Args:
        data: one sensor's readings.
        label_errors: label errors to repair before the fit.

    Returns:
        The same readings with ``offset_px`` and ``extra``; None where no lens can be fitted, or
        none is better than no distortion.
    """
    repaired, sigma = (label_errors or Hypothesis()).repair(data.readings_px, data.sigma_px)
    observed = ControlObservations(
        data.points_mm,
        repaired[:, None],
        np.where(np.isfinite(repaired), sigma, 1.0)[:, None],
        np.isinf(data.scale.dof),
        (data.sensor,),
    )
    fits = list(_fits(observed))
    if len(fits) < 2:
        return None
    count = len(fits[0].off)
    used = np.ones((count, 1), dtype=bool)
    # The noise as the richest lens leaves it: no less than it is stated to be.
    robust_scale = float(mad_sigma(np.abs(fits[-1].off)[:, None], used, fits[-1].parameters)[0])
    if observed.sigma_known:
        robust_scale = max(robust_scale, 1.0)
    cost = [
        float(np.minimum((fit.off / max(robust_scale, 1e-12)) ** 2, BIWEIGHT_LIMIT**2).sum())
        + fit.parameters * np.log(count)
        for fit in fits
    ]
    model = fits[int(np.argmin(cost))].model
    if model.distortion is None:
        return None
    width = model.parameter_count
    columns = CameraStack.of([model]).parameter_jacobian(data.points_mm)[
        :, 0, PARAMETER_COUNT + 1 : width
    ]
    columns = columns / np.maximum(np.abs(columns[data.observed_mask]).max(axis=0), 1e-12)
    plain = CameraStack.of([replace(model, distortion=None)]).project(data.points_mm)[:, 0]
    offset = CameraStack.of([model]).project(data.points_mm)[:, 0] - plain
    if not (np.isfinite(offset).all() and np.isfinite(columns).all()):
        return None
    return replace(data, offset_px=offset, extra=columns)


def _fits(observed: ControlObservations) -> Iterator[_RobustFit]:
    """Yield the camera without distortion, and those with each set of terms that can be fitted."""
    rows = observed.observed_mask[:, 0]
    try:
        undistorted = fit_undistorted(observed, "robust")
    except NOT_FITTED:
        return
    yield _fit(observed, undistorted.models[0], PARAMETER_COUNT)
    for name in CANDIDATES:
        terms = preset_terms(name)
        # The offset along the slit has a prior: it is not counted.
        if rows.sum() < READINGS_EACH * (PARAMETER_COUNT + len(terms)):
            continue
        try:
            fitted = fit_distorted(observed, undistorted, [terms], "robust")
        except NOT_FITTED:
            continue
        yield _fit(observed, fitted.models[0], PARAMETER_COUNT + len(terms))


def _fit(observed: ControlObservations, model: SensorModel, parameters: int) -> _RobustFit:
    off = (CameraStack.of([model]).project(observed.points_mm) - observed.readings_px)[:, 0]
    off = (off / observed.sigma_px[:, 0])[observed.observed_mask[:, 0]]
    return _RobustFit(model, np.nan_to_num(off, nan=np.inf), parameters)
