"""Fixed patterns: what differs from pixel to pixel of a sensor, the same in every exposure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector

Array = NDArray[np.float64]

_RESPONSE, _DARK, _OFFSET = range(3)


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """The pixels of S sensors, as they were made.

    Args:
        response: electrons per electron of a nominal pixel, shape (S, P).
        dark_electrons: mean dark signal of an exposure, shape (S, P).
        offset_counts: the count without light and dark signal, shape (S, P).
    """

    response: Array
    dark_electrons: Array
    offset_counts: Array


def fixed_pattern(detector: Detector, sensors: int, pixels: int, seed: int) -> FixedPattern:
    """Make the pixels of S sensors; those of a sensor depend on its number and the seed alone.

    The response and the offset are normal; the dark signal is log-normal, as it is positive
    and has pixels that stand out. Terms as in EMVA 1288: PRNU, DSNU.

    Args:
        detector: nominal values and their deviations from pixel to pixel.
        sensors: S.
        pixels: P.
        seed: zero or positive.
    """

    def normal(kind: int) -> Array:
        seeds = [np.random.SeedSequence(seed, spawn_key=(n, kind)) for n in range(sensors)]
        rows = [np.random.default_rng(sequence).standard_normal(pixels) for sequence in seeds]
        return np.array(rows).reshape(sensors, pixels)

    response = 1.0 + detector.response_nonuniformity * normal(_RESPONSE)
    # exp of a normal number has the mean exp(s^2 / 2) and the relative variance exp(s^2) - 1.
    log_deviation = np.sqrt(np.log1p(detector.dark_nonuniformity**2))
    relative = np.exp(log_deviation * normal(_DARK) - 0.5 * log_deviation**2)
    offset = detector.offset_counts + detector.offset_nonuniformity_counts * normal(_OFFSET)
    return FixedPattern(response.clip(0.0), detector.dark_electrons * relative, offset)
