"""Decoding of a coded shadow by cross-correlation with a template."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import irfft, next_fast_len, rfft

from compute.errors import InvalidParameter
from compute.signal.coded_aperture.shadow_template import ShadowTemplate

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MaskShift:
    """Shifts of a template in scans; arrays of the scans' leading shape.

    Args:
        shift_px: pixel of the scan on which the template's first one lies [px].
        peak: correlation at the peak, 1 for a scan that is the template, whatever its light.
        second_ratio: the highest correlation outside the main lobe, relative to the peak; near
            1: the shift is ambiguous.
    """

    shift_px: Array
    peak: Array
    second_ratio: Array


def read_by_correlation(scans: ArrayLike, template: ShadowTemplate) -> Array:
    """Return the readings of scans by ``decode_mask``, shape (...) [px].

    Args:
        scans: counts or electrons, shape (..., P).
        template: the shadow of a reference point.

    Raises:
        InvalidParameter: a scan that is too short, not finite, or of no contrast.
    """
    shift = decode_mask(scans, template.pixel_values).shift_px - template.first_px
    return np.asarray(shift + template.reading_px)


def decode_mask(scans: ArrayLike, template: ArrayLike) -> MaskShift:
    """Find the shift of a shadow by cross-correlation, thesis [2.16] to [2.18].

    ``R(m) = sum x(n) y(n + m)`` for all shifts, negative ones too, as the inverse transform
    of the cross-power spectrum, padded so that nothing wraps around. The scan's mean is taken
    off first: even ambient light then gives no slope, as long as the template is dark at its
    ends or reaches over the whole scan. The peak is refined by the parabola through its
    neighbours. The main lobe ends at the first minimum of the template's own correlation.

    This is the plain method: it weights all pixels alike, and its parabola is not the shape of
    the peak. Its deviation is 1.0 to 1.1 times the Cramer-Rao bound of ``shift_bound_px`` where
    the shift is a whole number of pixels and 1.3 times midway, for bars of 150 um behind a gap
    of 10 mm (printed by tests/compute/optics/coded_aperture/test_cramer_rao.py).

    One template fits one distance. The shadow is 1 + gap / Z as wide as the code, so that of a
    marker at another distance runs off the template towards the ends of the scan; the correlation
    reads the mean of that over the part of the code that is on the scan, which is zero only in
    its middle. Behind the windows of the profile coda-mpx30 the template for 3 m misreads by
    -0.15 to +0.02 px at 2.5 m and by -0.01 to +0.08 px at 3.5 m, that of the distance itself
    by 0.02 px RMS at either, the method's own error off the axis (printed by
    tests/compute/optics/coded_aperture/test_correlation_template.py); ``mask_template`` makes it.

    Args:
        scans: counts or electrons, shape (..., P).
        template: the software model of the mask's shadow, e.g. the shadow of a reference point
            (it may be longer than a scan), shape (T,).

    Raises:
        InvalidParameter: a scan or template that is too short, not finite, or of no contrast.
    """
    scan = np.asarray(scans, dtype=np.float64)
    model = np.asarray(template, dtype=np.float64)
    if model.ndim != 1 or model.size < 3:
        raise InvalidParameter(
            f"template has the shape {model.shape}; it must have one axis of 3 or more pixels",
            shape=model.shape,
        )
    if scan.ndim < 1 or scan.shape[-1] < 3:
        raise InvalidParameter(
            f"scans have the shape {scan.shape}; their last axis must have 3 or more pixels",
            shape=scan.shape,
        )
    if not (np.isfinite(model).all() and np.isfinite(scan).all()):
        raise InvalidParameter("scans or template hold a value that is not finite")
    if np.ptp(model) == 0.0:
        raise InvalidParameter(
            f"template is {model[0]} everywhere; it must have contrast", template=float(model[0])
        )
    scan = scan - scan.mean(axis=-1, keepdims=True)
    length = scan.shape[-1] + model.size - 1
    size = next_fast_len(length, real=True)
    correlation = irfft(rfft(scan, size) * rfft(model, size).conj(), size)
    # Shift 0 comes first: put the negative shifts before it.
    lag = np.arange(1 - model.size, scan.shape[-1])
    correlation = correlation[..., lag % size]
    return _peaks(correlation, lag, _lobe(model - model.mean(), size), _scale(scan, model))


def _scale(scan: Array, model: Array) -> Array:
    """Return the product of the norms about the means, never zero."""
    norm = np.sqrt((scan**2).sum(axis=-1) * ((model - model.mean()) ** 2).sum())
    return np.asarray(np.maximum(norm, np.finfo(np.float64).tiny))


def _lobe(model: Array, size: int) -> int:
    """Return the shift at which the template's own correlation ceases to fall [px]."""
    autocorrelation = irfft(abs(rfft(model, size)) ** 2, size)[: size // 2]
    rising = np.flatnonzero(np.diff(autocorrelation) >= 0.0)
    return int(rising[0]) if len(rising) else len(autocorrelation)


def _peaks(correlation: Array, lag: NDArray[np.int64], lobe: int, scale: Array) -> MaskShift:
    best = correlation.argmax(axis=-1, keepdims=True)
    inner = np.clip(best, 1, len(lag) - 2)
    before, at, after = (
        np.take_along_axis(correlation, inner + step, axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    bend = before - 2.0 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(bend < 0.0, 0.5 * (before - after) / bend, 0.0)
    part = np.clip(part, -1.0, 1.0)
    height = at - 0.25 * (before - after) * part
    outside = abs(np.arange(len(lag)) - best) > lobe
    second = np.where(outside, correlation, -np.inf).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(height > 0.0, np.maximum(second, 0.0) / height, 1.0)
    return MaskShift(lag[inner[..., 0]] + part, height / scale, ratio)
