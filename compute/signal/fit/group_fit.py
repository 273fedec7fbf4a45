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
from compute.signal.fit.window_model import Array, Layout, Windows, evaluate
from compute.signal.peaks import PeakFlag
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
) -> tuple[GroupFit, ...]:
    """Fit the peaks of one scan as ``fit_scans`` does, and return all details.

    Peaks beyond the room of ``settings.search`` that were found by fits are all told.

    Args:
        values: counts, shape (P,).
        settings: of the fit.
        noise: of the sensors.
        shape: the line-spread function; None: a Gaussian.
        sensor: number of the scan's sensor.

    Returns:
        The groups, in the order of their places.

    Raises:
        InvalidParameter: a scan of another type or shape.
    """
    scans = values[None]
    check_scans(scans)
    shape = LineSpreadFunction.gaussian() if shape is None else shape
    # Line l belongs to sensor l: the wanted one stands last, after empty ones.
    own = sensor % len(noise)
    scans = np.concatenate([np.zeros((own, len(values)), np.uint16), scans])
    candidates = find_peaks_reference(scans, settings.search, noise)
    groups = form_groups(candidates, len(values), settings)
    found: list[GroupFit] = []
    for number, fits in fit_groups(scans, groups, candidates, settings, noise, shape):
        part = groups[number]
        for selected in fits:
            peaks = collect_fitted_peaks(
                selected, number, part, candidates, len(values), settings, shape
            )
            good = selected[selected.solution.good]
            gain = noise.electrons_per_count[own]
            found += [
                _fitted(good, row, peaks, float(gain), settings, shape)
                for row in range(len(good.rows))
            ]
            bad = selected[~selected.solution.good]
            peaks = collect_unfitted_peaks(selected, number, part, candidates)
            found += [_unfitted(bad, row, peaks) for row in range(len(bad.rows))]
    return tuple(sorted(found, key=lambda group: float(group.position_px[0])))


def _fitted(
    selected: SelectedFits,
    row: int,
    peaks: FlatPeaks,
    gain: float,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> GroupFit:
    layout, solution = selected.layout, selected.solution
    count = layout.peaks
    own = peaks[np.arange(row * count, (row + 1) * count)]
    windows = selected.windows[np.array([row])]
    order = np.argsort(solution.parameters[row, layout.position], kind="stable")
    index = np.arange(layout.size)
    index[layout.light] = index[layout.light][order]
    index[layout.position] = index[layout.position][order]
    parameters = solution.parameters[row, index]
    model = evaluate(windows, parameters[None], layout, settings, shape)
    inside = slice(0, int(windows.last_px[0] - windows.first_px[0]) + 1)
    residual = (windows.values - model.mean) / np.sqrt(model.variance)
    width = float(np.exp(parameters[-1]))
    covariance = solution.covariance[row][np.ix_(index, index)]
    return GroupFit(
        int(windows.first_px[0]),
        windows.values[0, inside],
        windows.used[0, inside],
        model.mean[0, inside],
        residual[0, inside],
        own.flags,
        own.position_px,
        own.sigma_px,
        own.amplitude,
        parameters[layout.light],
        parameters[layout.light] * gain,
        width,
        width * float(np.sqrt(covariance[-1, -1])),
        float(parameters[0]),
        float(parameters[1]) if layout.slope else 0.0,
        _names(layout),
        covariance,
        float(solution.chi2[row]),
        int(solution.dof[row]),
    )


def _unfitted(selected: SelectedFits, row: int, peaks: FlatPeaks) -> GroupFit:
    layout = selected.layout
    count = layout.peaks
    own = peaks[np.arange(row * count, (row + 1) * count)]
    windows: Windows = selected.windows[np.array([row])]
    inside = slice(0, int(windows.last_px[0] - windows.first_px[0]) + 1)
    values = windows.values[0, inside]
    nothing, each = np.full(len(values), np.nan), np.full(count, np.nan)
    return GroupFit(
        int(windows.first_px[0]),
        values,
        windows.used[0, inside],
        nothing,
        nothing,
        own.flags,
        own.position_px,
        own.sigma_px,
        own.amplitude,
        each,
        each,
        np.nan,
        np.nan,
        np.nan,
        np.nan,
        _names(layout),
        np.full((layout.size, layout.size), np.nan),
        np.nan,
        0,
    )


def _names(layout: Layout) -> tuple[str, ...]:
    peaks = range(1, layout.peaks + 1)
    return (
        "background",
        *(("slope",) if layout.slope else ()),
        *(f"light {k}" for k in peaks),
        *(f"position {k}" for k in peaks),
        "ln width",
    )
