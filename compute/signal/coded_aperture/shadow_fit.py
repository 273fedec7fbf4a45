"""Maximum-likelihood fit of known shadows, and readings of several sensors by it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc
from scipy.stats import norm

from compute.errors import InvalidParameter
from compute.parameter_checks import require
from compute.signal.array_rows import ArrayRows
from compute.signal.coded_aperture.fisher_scoring import ShadowModel, ShadowSolution, solve
from compute.signal.coded_aperture.shadow_search import ShadowSearch
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

CLIPPED_CONTRAST_THRESHOLD: Final = 0.9
"""A shadow is clipped with less of the contrast on the scan than this share of the most."""

_PIXELS_AT_ONCE: Final = 1 << 15


@dataclass(frozen=True)
class ShadowSettings:
    """Settings of the search and the fit of shadows.

    Args:
        fit_scale: fit the shadow's magnification too. A shadow is 1 + gap / Z as wide as the
            code, so one template fits one distance; with its scale free it fits others, and the
            position costs more noise where the pattern lies to one side of the reading.
        false_alarms_per_line: largest expected number of false readings of a scan without a shadow.
        ambiguity_probability: a shadow is ambiguous where another place is this much as likely.
        misfit_probability: a fit is poor if a larger chi-square is less probable than this.

    Raises:
        InvalidParameter: a value outside its range.
    """

    fit_scale: bool = False
    false_alarms_per_line: float = 1e-3
    ambiguity_probability: float = 1e-4
    misfit_probability: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("false_alarms_per_line", "ambiguity_probability", "misfit_probability"):
            value = float(getattr(self, name))
            require(0.0 < value < 1.0, "lie between 0 and 1", **{name: value})


@dataclass(frozen=True, eq=False)
class ShadowFit(ArrayRows):
    """Shadows of L scans, one each; NaN where none is found.

    Args:
        found: the shadow stands out of the noise, the fit converged, and more pixels than
            parameters are below full scale, bool, shape (L,).
        flags: PeakFlag values, int32, shape (L,). SATURATED: pixels at full scale were left out.
            CLIPPED: a tenth or more of the contrast that a scan can hold is off the scan.
            AMBIGUOUS: another shift is not excluded. POOR_FIT: the template does not explain the
            scan, and the standard deviation is too small.
        shift_px: shift against the template [px], shape (L,).
        sigma_px: its standard deviation, by the noise model at the fit, brightness and ambient
            level (and scale) being unknown too [px], shape (L,).
        amplitude: from the darkest to the brightest place of the shadow [counts], shape (L,).
        ambient: level of a dark pixel of the template, the offset included [counts], shape (L,).
        scale: magnification against the template's, shape (L,); 1 where it is not fitted.
        reduced_chi2: misfit per degree of freedom, shape (L,).
    """

    found: NDArray[np.bool_]
    flags: NDArray[np.int32]
    shift_px: Array
    sigma_px: Array
    amplitude: Array
    ambient: Array
    scale: Array
    reduced_chi2: Array

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.found)


class ShadowFitter:
    """Finds a shadow by correlation and fits it by maximum likelihood.

    The model of a pixel is ``c + a f(i - shift)`` with the template f, its variance that of
    SensorNoise at the model's light (not at the measured value, which would draw the level down).
    Started at the correlation's peak, Fisher's scoring solves for shift, a and c together; what
    it finds reaches the Cramer-Rao bound with a and c unknown, whatever the phase: 1.00 to 1.01
    of it from 150 to 100,000 electrons in the brightest pixel. Plain correlation has 1.1 times
    its own bound at 150, and 28 times at 100,000, where its parabola's 0.02 px do not become
    less (printed by tests/compute/signal/coded_aperture/test_shadow_efficiency.py). Below a few
    deviations of noise, where the bound nears the width of the bars' edges, no estimator
    reaches it.

    The template is of one place. Behind the windows of the profile coda-mpx30, whose code is
    longer than the sensor, one for 3 m in the middle reads noiseless shadows of the whole volume
    to 0.004 px RMS at 3 m and 0.06 and 0.04 px at 2.5 and 3.5 m; with ``fit_scale`` to 0.004,
    0.011 and 0.003 px, correlation to 0.025, 0.075 and 0.046 px (printed by
    tests/compute/signal/coded_aperture/test_shadow_distances.py). In bright light what is left, the
    diffraction off the axis, is more than the standard deviation, and is flagged.

    A shadow is found where the correlation is so high that less than
    ``false_alarms_per_line`` of noise are expected, by the bound that all shifts are
    independent; it is ambiguous where the second lobe's likelihood, in the noise of the scan's
    mean, is more than ``ambiguity_probability`` of the first's.

    Args:
        template: the shadow of a reference point.
        pixels: pixels of a scan.
        noise: noise of one sensor, or of S; scan l of a batch is of sensor ``l % S``.
        settings: what counts as found, and what is fitted.

    Raises:
        InvalidParameter: a scan that is too short.
    """

    def __init__(
        self,
        template: ShadowTemplate,
        pixels: int,
        noise: SensorNoise,
        settings: ShadowSettings | None = None,
    ) -> None:
        self.template = template
        self.pixels = pixels
        self.settings = settings or ShadowSettings()
        self._noise = noise
        self.search = ShadowSearch(template, pixels)
        """Where the shadow is to the pixel."""
        self._model = ShadowModel(template, pixels, self.settings.fit_scale)
        rate = self.settings.false_alarms_per_line
        self.threshold_sigma = float(norm.isf(rate / self.search.count))
        """Minimum correlation of a shadow, in standard deviations of that of noise."""

    def fit(self, scans: NDArray[np.uint16]) -> ShadowFit:
        """Fit scans of counts, uint16, shape (L, P).

        Raises:
            InvalidParameter: another type or shape.
        """
        if scans.dtype != np.uint16 or scans.ndim != 2 or scans.shape[1] != self.pixels:
            raise InvalidParameter(
                f"scans have the type {scans.dtype} and the shape {scans.shape}; it must be "
                f"uint16 and (L, {self.pixels})",
                type=str(scans.dtype),
                shape=scans.shape,
            )
        sensor = np.arange(len(scans)) % len(self._noise)
        chunk = max(1, _PIXELS_AT_ONCE // self.pixels)
        parts = [slice(start, start + chunk) for start in range(0, max(len(scans), 1), chunk)]
        return ShadowFit.concatenate([self._fit_some(scans[part], sensor[part]) for part in parts])

    def _fit_some(self, scans: NDArray[np.uint16], sensor: NDArray[np.int64]) -> ShadowFit:
        count = len(scans)
        fit = ShadowFit(
            np.zeros(count, np.bool_), np.zeros(count, np.int32), *np.full((6, count), np.nan)
        )
        counts = scans.astype(np.float64)
        noise = self._noise.of_scans(sensor)
        first = self.search.find(counts)
        mean_variance = noise.variance(counts.mean(axis=1, keepdims=True))[:, 0]
        significant = np.flatnonzero(first.height > self.threshold_sigma * np.sqrt(mean_variance))
        if not len(significant):
            return fit
        full = counts[significant] >= self._noise.full_scale_counts[sensor[significant]][:, None]
        solution = solve(
            self._model, counts[significant], ~full, noise[significant], first.shift_px[significant]
        )
        lead = (first.height[significant] ** 2 - first.second_height[significant] ** 2) / (
            2.0 * mean_variance[significant]
        )
        # A fit that leaves the main lobe has not refined what was found. NaN is not near either.
        near = np.abs(solution.shift_px - first.shift_px[significant]) <= max(
            self.search.lobe_px, 1
        )
        # With as many pixels as parameters a fit explains whatever there is.
        good = np.flatnonzero(near & (solution.amplitude > 0.0) & (solution.dof >= 1.0))
        solution, candidate = solution[good], significant[good]
        fit.found[candidate] = True
        fit.shift_px[candidate], fit.sigma_px[candidate] = solution.shift_px, solution.sigma_px
        fit.amplitude[candidate] = solution.amplitude * self.template.height
        dark = float(self.template.cells.min())
        fit.ambient[candidate] = solution.amplitude * dark + solution.ambient
        fit.scale[candidate] = solution.scale
        fit.reduced_chi2[candidate] = solution.chi2 / solution.dof
        fit.flags[candidate] = self._flags(solution, full[good], lead[good])
        return fit

    def _flags(
        self, solution: ShadowSolution, saturated: NDArray[np.bool_], lead: Array
    ) -> NDArray[np.int32]:
        flags = np.zeros(len(lead), dtype=np.int32)
        flags[saturated.any(axis=1)] |= int(PeakFlag.SATURATED)
        share = self.search.share(solution.shift_px)
        flags[share < CLIPPED_CONTRAST_THRESHOLD] |= int(PeakFlag.CLIPPED)
        flags[lead < -np.log(self.settings.ambiguity_probability)] |= int(PeakFlag.AMBIGUOUS)
        probability = chdtrc(solution.dof, solution.chi2)
        flags[probability < self.settings.misfit_probability] |= int(PeakFlag.POOR_FIT)
        return flags


class MaskReader:
    """Reads the shadows of single markers on S sensors behind coded windows.

    Args:
        templates: one for each of the S sensors, or one for all.
        pixels: pixels of a scan.
        noise: noise of the S sensors, or of one for all; scan l of a batch is of sensor
            ``l % S``, S the larger of both numbers.
        settings: what counts as found, and what is fitted.

    Raises:
        InvalidParameter: numbers of templates and of sensors that do not agree, or a scan that
            is too short.
    """

    def __init__(
        self,
        templates: Sequence[ShadowTemplate],
        pixels: int,
        noise: SensorNoise,
        settings: ShadowSettings | None = None,
    ) -> None:
        sensors = max(len(templates), len(noise))
        if not (len(templates) in (1, sensors) and len(noise) in (1, sensors)):
            raise InvalidParameter(
                f"there are {len(templates)} templates and the noise of {len(noise)} sensors; "
                "give one, or one per sensor",
                templates=len(templates),
                sensors=len(noise),
            )
        self.pixels = pixels
        self._fitters = tuple(
            ShadowFitter(
                templates[sensor % len(templates)],
                pixels,
                noise[np.array([sensor % len(noise)])],
                settings,
            )
            for sensor in range(sensors)
        )

    def read(self, scans: NDArray[np.uint16]) -> PeakBatch:
        """Read scans of counts, uint16, shape (L, P), as a batch of one peak a scan (K = 1).

        Positions are readings, ``template.reading_px + shift``, which may lie beyond the scan's
        ends; widths are those of the lit patterns, as magnified.

        Raises:
            InvalidParameter: another type or shape.
        """
        batch = PeakBatch.empty(len(scans), 1)
        for sensor, fitter in enumerate(self._fitters):
            of_sensor = slice(sensor, None, len(self._fitters))
            fit = fitter.fit(scans[of_sensor])
            template = fitter.template
            batch.count[of_sensor] = fit.found
            batch.position_px[of_sensor, 0] = template.reading_px + fit.shift_px
            batch.sigma_px[of_sensor, 0] = fit.sigma_px
            batch.amplitude[of_sensor, 0] = fit.amplitude
            batch.width_px[of_sensor, 0] = template.lit_width_px * fit.scale
            batch.flags[of_sensor, 0] = fit.flags
            batch.reduced_chi2[of_sensor, 0] = fit.reduced_chi2
        return batch
