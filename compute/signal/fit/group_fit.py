"""Details of one fitted group of peaks: pixels, model, residuals, covariance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.fit.candidate_groups import form_groups
from compute.signal.fit.fit_reference import check_scans, fit_groups
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.model_order import SelectedFits
from compute.signal.fit.peak_batches import FlatPeaks, collect_fitted_peaks, collect_unfitted_peaks
from compute.signal.fit.window_model import Array
from compute.signal.peaks import PeakFlag
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise


@dataclass(frozen=True, eq=False)
class GroupFit:
    """K peaks that were fitted together in n pixels; NaN where no fit was possible.

    Args:
        first_px: first pixel of the window.
        values: counts of the window's pixels, shape (n,).
        used: pixels that were fitted; the others are saturated, shape (n,).
        model: expected counts, shape (n,).
        residual_sigma: differences from these in standard deviations, shape (n,).
        flags: PeakFlag values of the peaks, shape (K,).
        position_px: of the peaks, in ascending order [px], shape (K,).
        sigma_px: their standard deviations [px], shape (K,).
        amplitude: light in a pixel about the peak's position [counts], shape (K,).
        light_counts: light of each peak [counts], shape (K,).
        light_electrons: the same [electrons], shape (K,).
        width_px: the group's width: a Gaussian's deviation, or in the shape's own unit [px].
        width_sigma_px: its standard deviation [px]; zero where it is known.
        background_counts: level in the window's middle.
        slope_counts_per_px: slope of the background.
        parameters: names of the covariance's rows.
        covariance: of all parameters: lights in counts, the width as its logarithm.
        chi2: misfit.
        dof: its degrees of freedom.
    """

    first_px: int
    values: Array
    used: NDArray[np.bool_]
    model: Array
    residual_sigma: Array
    flags: NDArray[np.int64]
    position_px: Array
    sigma_px: Array
    amplitude: Array
    light_counts: Array
    light_electrons: Array
    width_px: float
    width_sigma_px: float
    background_counts: float
    slope_counts_per_px: float
    parameters: tuple[str, ...]
    covariance: Array
    chi2: float
    dof: int

    @property
    def fitted(self) -> bool:
        """Say whether the fit was possible."""
        return not bool((self.flags & PeakFlag.UNFITTED).any())


def fit_scan(
    values: NDArray[np.uint16],
    settings: FitSettings,
    noise: SensorNoise,
    shape: LineSpreadFunction | None = None,
    sensor: int = 0,
    corrections: PixelCorrections | None = None,
) -> tuple[GroupFit, ...]:
    """Fit the peaks of one scan as ``fit_scans`` does, and return all details.

    Peaks beyond the room of ``settings.search`` that were found by fits are all told.

    Args:
        values: counts, shape (P,).
        settings: of the fit.
        noise: of the sensors.
        shape: the line-spread function; None: a Gaussian.
        sensor: number of the scan's sensor.
        corrections: of the sensors' pixels; None: counts are taken as they are.

    Returns:
        The groups, in the order of their places.

    Raises:
        InvalidParameter: a scan of another type or shape.
    """
    scans = values[None]
    check_scans(scans)
    shape = LineSpreadFunction.gaussian() if shape is None else shape
    # Line l belongs to sensor l: the wanted one stands last, after empty ones.
    sensor_index = sensor % len(noise)
    scans = np.concatenate([np.zeros((sensor_index, len(values)), np.uint16), scans])
    candidates = find_peaks_reference(scans, settings.search, noise, corrections)
    groups = form_groups(candidates, len(values), settings)
    gain = float(noise.electrons_per_count[sensor_index])
    group_fits: list[GroupFit] = []
    for fits in fit_groups(scans, groups, candidates, settings, noise, shape, corrections):
        good = fits.solution.good
        for some, peaks in (
            (fits[good], collect_fitted_peaks(fits, candidates, len(values))),
            (fits[~good], collect_unfitted_peaks(fits, candidates)),
        ):
            group_fits += [_group_fit(some, row, peaks, gain) for row in range(len(some.groups))]
    return tuple(sorted(group_fits, key=lambda group: float(group.position_px[0])))


def _group_fit(selected: SelectedFits, row: int, peaks: FlatPeaks, gain: float) -> GroupFit:
    """Return the details of a group; ``peaks`` are those of all groups that are selected."""
    model, solution = selected.model, selected.solution[np.array([row])]
    windows = selected.windows[np.array([row])]
    group_peaks = peaks[np.arange(row * model.peaks, (row + 1) * model.peaks)]
    # Peaks in the order of their positions.
    order = np.argsort(solution.parameters[0, model.position], kind="stable")
    index = np.arange(model.size)
    index[model.light] = index[model.light][order]
    index[model.position] = index[model.position][order]
    parameters, covariance = (
        solution.parameters[0, index],
        solution.covariance[0][np.ix_(index, index)],
    )
    mean = residual = np.full(windows.values.shape, np.nan)
    good = bool(solution.good[0])
    if good:
        expected = model.evaluate(windows, parameters[None])
        mean = expected.mean
        residual = (windows.values - mean) / np.sqrt(expected.variance)
    else:
        parameters = np.full(model.size, np.nan)
    inside = slice(0, int(windows.last_px[0] - windows.first_px[0]) + 1)
    width = float(np.exp(parameters[-1]))
    sloped = model.settings.background == "slope"
    counts = range(1, model.peaks + 1)
    return GroupFit(
        first_px=int(windows.first_px[0]),
        values=windows.values[0, inside],
        used=windows.used[0, inside],
        model=mean[0, inside],
        residual_sigma=residual[0, inside],
        flags=group_peaks.flags,
        position_px=group_peaks.position_px,
        sigma_px=group_peaks.sigma_px,
        amplitude=group_peaks.amplitude,
        light_counts=parameters[model.light],
        light_electrons=parameters[model.light] * gain,
        width_px=width,
        width_sigma_px=width * float(np.sqrt(covariance[-1, -1])),
        background_counts=float(parameters[0]),
        slope_counts_per_px=float(parameters[1]) if sloped or not good else 0.0,
        parameters=(
            "background",
            *(["slope"] if sloped else []),
            *(f"light {k}" for k in counts),
            *(f"position {k}" for k in counts),
            "ln width",
        ),
        covariance=covariance,
        chi2=float(solution.chi2[0]),
        dof=int(solution.dof[0]) if good else 0,
    )
