"""Shadows of coded apertures in posted scans: their readings and diagnostics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.signal.coded_aperture.shadow_fit import CLIPPED_CONTRAST_THRESHOLD, ShadowFitter
from compute.signal.coded_aperture.shadow_search import CorrelationPeak
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.schema import FitWindow, Stage

Array = NDArray[np.float64]
Scans = NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Shadow:
    """Search for the shadow in one line.

    Args:
        peaks: of one line, the shadow or none.
        response_sigma: the highest correlation, in standard deviations of that of noise.
        limit_sigma: a shadow's is above this.
        windows: the fit, of the whole line; empty where there is none.
        stage: the correlation at every shift, by the reading that it means.
    """

    peaks: PeakBatch
    response_sigma: float
    limit_sigma: float
    windows: list[FitWindow]
    stage: Stage


def read_shadow(
    line: Scans, fitter: ShadowFitter, method: MaskMethod, noise: SensorNoise
) -> Shadow:
    """Read the shadow in one line of a sensor.

    Args:
        line: counts, shape (P,).
        fitter: of the shadow's template.
        method: settings.
        noise: of the sensor.
    """
    search = fitter.search
    counts = line[None].astype(np.float64)
    level = max(float(counts.mean()) - noise.offset_counts[0], 0.0)
    sigma = float(np.sqrt(noise.dark_variance[0] + noise.photon_variance[0] * level))
    contrasts = search.heights(counts)
    heights = contrasts[0] / sigma
    top = float(heights.max())
    peaks = PeakBatch.empty(1, 1)
    windows = []
    if method.estimator == "fit":
        windows = _fitted(line, fitter, noise, peaks)
    elif top > fitter.threshold_sigma:
        _correlated(counts, fitter, method, search.highest(contrasts), sigma, peaks)
        if (line >= noise.full_scale_counts[0]).any():
            peaks.flags[0, 0] |= int(PeakFlag.SATURATED)
    first_px = fitter.template.reading_px + search.first_shift_px
    stage = Stage(
        name="correlation", unit="deviations", shift_px=-first_px, values=heights.tolist()
    )
    return Shadow(peaks, top, fitter.threshold_sigma, windows, stage)


def _fitted(
    line: Scans, fitter: ShadowFitter, noise: SensorNoise, peaks: PeakBatch
) -> list[FitWindow]:
    fit, template = fitter.fit(line[None]), fitter.template
    if not fit.found[0]:
        return []
    reading = template.reading_px + float(fit.shift_px[0])
    sigma, scale = float(fit.sigma_px[0]), float(fit.scale[0])
    peaks.count[0] = 1
    peaks.position_px[0, 0], peaks.sigma_px[0, 0] = reading, sigma
    peaks.amplitude[0, 0] = fit.amplitude[0]
    peaks.width_px[0, 0] = template.lit_width_px * scale
    peaks.flags[0, 0] = fit.flags[0]
    peaks.reduced_chi2[0, 0] = fit.reduced_chi2[0]
    place = template.reading_px + (np.arange(float(len(line))) - reading) / scale
    value, _, known = template.at(place)
    dark = float(template.cells.min())
    model = fit.ambient[0] + fit.amplitude[0] / template.height * (value - dark)
    light = np.maximum(model - noise.offset_counts[0], 0.0)
    rest = (line - model) / np.sqrt(noise.dark_variance[0] + noise.photon_variance[0] * light)
    used = known & (line < noise.full_scale_counts[0])
    # Shift, brightness and level, and the scale where it is one.
    dof = int(used.sum()) - (4 if fitter.settings.fit_scale else 3)
    return [
        FitWindow(
            first_px=0,
            values=line.astype(float).tolist(),
            used=used.tolist(),
            model=_where(known, model),
            residual_sigma=_where(known, rest),
            position_px=[reading],
            sigma_px=[sigma],
            light_counts=[None],
            light_electrons=[None],
            width_px=None,
            width_sigma_px=None,
            background_counts=float(fit.ambient[0]),
            slope_counts_per_px=None,
            parameters=["position"],
            covariance=[[sigma**2]],
            chi2=float(fit.reduced_chi2[0]) * dof,
            dof=dof,
        )
    ]


def _correlated(
    counts: Array,
    fitter: ShadowFitter,
    method: MaskMethod,
    best: CorrelationPeak,
    sigma: float,
    peaks: PeakBatch,
) -> None:
    template = fitter.template
    found = decode_mask(counts, template.pixel_values)
    shift = float(found.shift_px[0]) - template.first_px
    flags = PeakFlag.NONE
    # As of the fit: another place is not so much less likely.
    lead = float(best.height[0] ** 2 - best.second_height[0] ** 2) / (2.0 * sigma**2)
    if lead < -np.log(method.ambiguity_probability):
        flags |= PeakFlag.AMBIGUOUS
    if float(fitter.search.share(np.array([shift]))[0]) < CLIPPED_CONTRAST_THRESHOLD:
        flags |= PeakFlag.CLIPPED
    peaks.count[0] = 1
    peaks.position_px[0, 0] = template.reading_px + shift
    peaks.flags[0, 0] = int(flags)


def _where(known: NDArray[np.bool_], values: Array) -> list[float | None]:
    return [float(value) if there else None for there, value in zip(known, values, strict=True)]
