"""Fisher scoring for shift, brightness, ambient level and scale of a shadow, scan by scan."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.array_rows import ArrayRows
from compute.signal.coded_aperture.shadow_template import ShadowTemplate, ShiftedTemplate
from compute.signal.sensor_noise import ScanNoise

Array = NDArray[np.float64]

_ITERATIONS: Final = 30
_CONVERGED: Final = 0.01
"""The last step is done when the next will be this part of the standard deviation; of the one
that the misfit says, where the template does not explain the scan and steps shrink slowly."""

_SHIFT, _BRIGHTNESS, _AMBIENT = range(3)
_LONGEST_PX: Final = 0.5
_LARGEST_SCALE_STEP: Final = 0.01
_MIN_STEP_PX: Final = 1e-12
_MIN_DETERMINANT: Final = 1e-9
"""Smallest determinant of an information matrix, scaled to a unit diagonal, that is inverted."""


@dataclass(frozen=True, eq=False)
class ShadowSolution(ArrayRows):
    """Fits of L scans; arrays of shape (L,), NaN where the iterations did not converge."""

    shift_px: Array
    sigma_px: Array
    amplitude: Array
    ambient: Array
    scale: Array
    chi2: Array
    dof: Array


class ShadowModel:
    """Model of a scan: ambient level plus brightness times the template, with derivatives.

    A pixel i sees the template f at ``r + (i - r - shift) / scale``, r the reference's reading.

    Args:
        template: the template.
        pixels: pixels of a scan.
        fit_scale: the scale is a parameter.
    """

    def __init__(self, template: ShadowTemplate, pixels: int, fit_scale: bool) -> None:
        self.fit_scale = fit_scale
        self.parameters = 4 if fit_scale else 3
        self._template = template
        self._shifted = ShiftedTemplate(template, pixels)
        self._pixel = np.arange(float(pixels))

    def at(self, shift_px: Array, scale: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return the template, its derivatives by shift and scale, and where known, each (L, P).

        Args:
            shift_px: shifts of the scans, shape (L,) [px].
            scale: magnifications against the template's, shape (L,).
        """
        reading = self._template.reading_px
        if not self.fit_scale:
            value, slope, known = self._shifted.at(shift_px)
            return value, np.negative(slope, out=slope), slope, known
        arm = (self._pixel - reading - shift_px[:, None]) / scale[:, None]
        value, slope, known = self._template.at(reading + arm)
        by_shift = -slope / scale[:, None]
        return value, by_shift, by_shift * arm, known


@dataclass(eq=False)
class _State:
    """Current parameters of the fits of L scans; all of shape (L,)."""

    shift: Array
    brightness: Array
    ambient: Array
    scale: Array
    last_step_px: Array

    def advance(self, model: ShadowModel, scans: NDArray[np.int64], step: Array) -> Array:
        """Apply a step of some scans' parameters, (L', K), the scale last; bound the next.

        A long step is of a start far off: shortened, lest it leave the lobe. One that goes back
        is halved: in faint light steps would go to and fro for ever.

        Returns:
            How long the next step will be at most, as steps have shrunk so far, (L',) [px].
        """
        before, now = self.last_step_px[scans], step[:, _SHIFT]
        turned = np.where(now * before < 0.0, 2.0, 1.0)
        longest = np.maximum(np.abs(now) / _LONGEST_PX, turned)
        if model.fit_scale:
            longest = np.maximum(longest, np.abs(step[:, -1]) / _LARGEST_SCALE_STEP)
            self.scale[scans] += step[:, -1] / longest
        self.shift[scans] += now / longest
        self.brightness[scans] += step[:, _BRIGHTNESS]
        self.ambient[scans] += step[:, _AMBIENT]
        self.last_step_px[scans] = now
        shrunk = np.minimum(np.abs(now) / np.maximum(np.abs(before), _MIN_STEP_PX), 1.0)
        return np.asarray(np.abs(now) * np.maximum(shrunk, 1.0 - 1.0 / longest))


def solve(
    model: ShadowModel, counts: Array, good: NDArray[np.bool_], noise: ScanNoise, start_px: Array
) -> ShadowSolution:
    """Fit scans from initial shifts.

    Args:
        model: the template on the scan.
        counts: values, shape (L, P).
        good: which pixels count, shape (L, P).
        noise: of the scans.
        start_px: shifts to begin with, within the main lobe of the true ones, shape (L,).
    """
    zero = np.zeros(len(counts))
    state = _State(start_px.astype(np.float64), zero, zero, np.ones(len(counts)), zero.copy())
    solutions = ShadowSolution(*np.full((7, len(counts)), np.nan))
    moving = np.arange(len(counts))
    for iteration in range(_ITERATIONS):
        value, by_shift, by_scale, known = model.at(state.shift[moving], state.scale[moving])
        used = good[moving] & known
        if iteration == 0:
            state.brightness, state.ambient = _level(value, counts, used)
        light = state.brightness[moving][:, None]
        mean = state.ambient[moving][:, None] + light * value
        weight = used / noise[moving].variance(mean)
        rest = counts[moving] - mean
        columns = [light * by_shift, value, np.ones_like(value)]
        if model.fit_scale:
            columns.append(light * by_scale)
        step, inverse = _step(columns, weight, rest)
        sigma = np.sqrt(inverse[:, _SHIFT, _SHIFT])
        squares = (weight * rest**2).sum(axis=1)
        dof = used.sum(axis=1) - model.parameters
        misfit = np.sqrt(np.maximum(squares / np.maximum(dof, 1), 1.0))
        unconverged = state.advance(model, moving, step)
        last = (unconverged <= _CONVERGED * sigma * misfit) & (iteration > 0)
        ended = moving[last]
        solutions.shift_px[ended], solutions.sigma_px[ended] = state.shift[ended], sigma[last]
        solutions.amplitude[ended], solutions.ambient[ended] = (
            state.brightness[ended],
            state.ambient[ended],
        )
        solutions.scale[ended] = state.scale[ended]
        solutions.chi2[ended], solutions.dof[ended] = squares[last], dof[last]
        # What is not a number will never be.
        moving = moving[~last & np.isfinite(step).all(axis=1)]
        if not len(moving):
            break
    return solutions


def _level(value: Array, counts: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return brightness and ambient level by plain least squares, each (L,)."""
    number = np.maximum(used.sum(axis=1), 1)
    weighted_mean = (value * used).sum(axis=1) / number
    mean = (counts * used).sum(axis=1) / number
    contrast = (value - weighted_mean[:, None]) * used
    squares = (contrast**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        amplitude = np.where(squares > 0.0, (contrast * counts).sum(axis=1) / squares, 0.0)
    return amplitude, mean - amplitude * weighted_mean


def _step(columns: list[Array], weight: Array, rest: Array) -> tuple[Array, Array]:
    """Return the step of all parameters, (L, K), and the inverse of the information, (L, K, K).

    NaN where the information is singular: a scan without light tells no shift.
    """
    size = len(columns)
    information = np.empty((len(rest), size, size))
    score = np.empty((len(rest), size))
    for i, one in enumerate(columns):
        weighted = one * weight
        score[:, i] = np.einsum("lp,lp->l", weighted, rest)
        for j in range(i, size):
            information[:, i, j] = np.einsum("lp,lp->l", weighted, columns[j])
            information[:, j, i] = information[:, i, j]
    # Scaled to a unit diagonal: brightness and shift have units far apart.
    root = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = information / (root[:, :, None] * root[:, None, :])
    sound = np.isfinite(unit).all(axis=(1, 2))
    sound[sound] = np.linalg.det(unit[sound]) > _MIN_DETERMINANT
    inverse = np.full_like(unit, np.nan)
    inverse[sound] = np.linalg.inv(unit[sound])
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse /= root[:, :, None] * root[:, None, :]
    return np.einsum("lij,lj->li", inverse, score), inverse
