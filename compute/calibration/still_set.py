"""A still set of markers beside what a calibration expects of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration
from compute.calibration.weights import reading_sigma
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NonFiniteValue, TooFewPoints
from compute.reconstruction.points import reconstruct

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StillSet:
    """N markers that stand still, read by S sensors.

    Args:
        readings_px: now, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px]; None: the calibration's.
        places_mm: their known places, shape (N, 3) [mm]; or None.
        place_sigma_mm: standard deviation of each known coordinate [mm].
        earlier_px: their readings when the calibration was made, shape (N, S) [px]; or None.
        earlier_sigma_px: standard deviations of those; None: the calibration's.
    """

    readings_px: Array
    sigma_px: Array | None = None
    places_mm: Array | None = None
    place_sigma_mm: float = 0.0
    earlier_px: Array | None = None
    earlier_sigma_px: Array | None = None


@dataclass(frozen=True, eq=False)
class Comparison:
    """A still set beside what the calibration expects of it.

    Args:
        places_mm: the markers, shape (M, 3): those that can be compared.
        kept: their numbers in the set, shape (M,).
        off_px: read less expected, shape (M, S) [px]; NaN where not to be had.
        noise_px: deviation of ``off_px`` by the readings alone, shape (M, S).
        covariance_px2: of ``off_px``, shape (M, S, M, S).
    """

    places_mm: Array
    kept: NDArray[np.intp]
    off_px: Array
    noise_px: Array
    covariance_px2: Array


def compare(calibration: Calibration, still: StillSet) -> Comparison:
    """Return read less expected with its covariance; see ``check_drift``."""
    models = calibration.models
    readings = np.asarray(still.readings_px, dtype=np.float64)
    if readings.ndim != 2 or readings.shape[1] != len(models):
        raise InvalidParameter(
            f"readings have shape {readings.shape}; it must be (N, {len(models)})"
        )
    if (still.places_mm is None) == (still.earlier_px is None):
        raise InvalidParameter(
            "a still set has either known places or earlier readings; give one of them"
        )
    for name in ("sigma_px", "earlier_px", "earlier_sigma_px"):
        value = getattr(still, name)
        if value is not None and value.shape != readings.shape:
            raise InvalidParameter(
                f"{name} has shape {value.shape}; it must be {readings.shape} as the readings"
            )
    cameras = CameraStack.of(models)
    if still.earlier_px is not None:
        return _against_earlier(calibration, cameras, readings, still)
    assert still.places_mm is not None
    return _against_places(calibration, cameras, readings, still, still.places_mm)


def _against_earlier(
    calibration: Calibration, cameras: CameraStack, readings: Array, still: StillSet
) -> Comparison:
    earlier = np.asarray(still.earlier_px, dtype=np.float64)
    own = np.array([fit.sigma_px for fit in calibration.sensors])
    now = own if still.sigma_px is None else still.sigma_px
    then = own if still.earlier_sigma_px is None else still.earlier_sigma_px
    noise = np.broadcast_to(np.hypot(now, then), readings.shape)
    trusted = reading_sigma(calibration, earlier, still.earlier_sigma_px)
    places = reconstruct(cameras, earlier, trusted).position_mm
    kept = np.flatnonzero(np.isfinite(places[:, 0]))
    off = cameras.corrected(readings[kept]) - cameras.corrected(earlier[kept])
    _check_any(off)
    variance = np.where(np.isfinite(off), noise[kept] ** 2, 0.0)
    covariance = np.diag(variance.ravel()).reshape(*off.shape, *off.shape)
    return Comparison(places[kept], kept, off, noise[kept], covariance)


def _against_places(
    calibration: Calibration,
    cameras: CameraStack,
    readings: Array,
    still: StillSet,
    places_mm: Array,
) -> Comparison:
    places = np.asarray(places_mm, dtype=np.float64)
    if places.shape != (len(readings), 3):
        raise InvalidParameter(
            f"places have shape {places.shape}; {len(readings)} readings make ({len(readings)}, 3)"
        )
    if not np.isfinite(places).all():
        raise NonFiniteValue(
            f"place {int(np.argwhere(~np.isfinite(places))[0, 0]) + 1} is not finite"
        )
    if not 0.0 <= still.place_sigma_mm < np.inf:
        raise InvalidParameter(f"place_sigma_mm is {still.place_sigma_mm}; it must be 0 or more")
    noise = reading_sigma(calibration, readings, still.sigma_px)
    expected, by_place = cameras.linearised(places)
    off = cameras.corrected(readings) - expected
    _check_any(off)
    slopes = np.nan_to_num(cameras.parameter_jacobian(places))
    blocks = cameras.spread_covariance(np.array(calibration.covariance))
    covariance: Array = np.einsum("nsp,sptq,mtq->nsmt", slopes, blocks, slopes, optimize=True)
    markers = np.arange(len(places))
    by_place = np.nan_to_num(by_place)
    covariance[markers, :, markers] += (
        still.place_sigma_mm**2 * by_place @ by_place.transpose(0, 2, 1)
    )
    flat = np.array(covariance.reshape(off.size, off.size))
    flat[np.diag_indices(off.size)] += np.where(np.isfinite(off), noise**2, 0.0).ravel()
    return Comparison(places, markers, off, noise, flat.reshape(*off.shape, *off.shape))


def _check_any(off: Array) -> None:
    if not np.isfinite(off).any():
        raise TooFewPoints(
            "no marker of the still set can be compared: it must be read now and, without known "
            "places, have been read by three sensors or more before"
        )
