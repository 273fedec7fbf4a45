"""False-alarm rate of a matched filter: expected maxima of noise above a threshold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import ndtr, owens_t
from scipy.stats import chi2

from compute.errors import InvalidParameter
from compute.signal.detection.matched_filter import MatchedFilter

Array = NDArray[np.float64]

_HIGHEST = 12.0
_STEP = 0.01
_NODES = 64


@dataclass(frozen=True, eq=False)
class FalseAlarms:
    """Expected number of local maxima of a filter's response to noise, by their height.

    Exact for independent Gaussian noise of even deviation: the answers at a place x and its
    neighbours are trivariate normal with the correlations of the taps. Given the answer z at x,
    both neighbours are lower with a bivariate normal probability (Owen 1956,
    doi:10.1214/aoms/1177728074), and the integral over z above the threshold, summed over the
    places, is the number of maxima. Neighbouring answers being alike, that is less than
    ``P Q(t)`` (Q: the normal tail): at 4 deviations 0.9 times for peaks of 1 px, 0.6 for 2 px
    and 0.5 for 3 px.

    Args:
        log_expected_above: logarithm of the expected number above a height in standard deviations.
        pixels: of a scan.
    """

    log_expected_above: CubicSpline
    pixels: int

    @classmethod
    def of(cls, matched: MatchedFilter, pixels: int) -> "FalseAlarms":
        """Compute the expected maxima for scans of a length.

        Args:
            matched: the filter.
            pixels: pixels of a scan.

        Raises:
            InvalidParameter: a scan shorter than the filter.
        """
        short = min(pixels, 2 * len(matched.taps) + 3)
        rows = matched.matrix(short).astype(np.float64)
        # All places in the middle are alike; the short scan has one of each kind.
        many = np.ones(short)
        many[short // 2] += pixels - short
        height = np.arange(0.0, _HIGHEST + _STEP / 2, _STEP)
        density = np.zeros_like(height)
        for row in range(short):
            density += many[row] * _density(rows, row, height * matched.norm) * matched.norm
        # From the far end, where it is smallest: no digits are lost.
        reverse = CubicSpline(height, density[::-1]).antiderivative()
        tail = float(density[-1]) / _HIGHEST
        above = reverse(height)[::-1] + tail
        return cls(CubicSpline(height, np.log(above)), pixels)

    def expected(self, threshold_sigma: float, dof: float = np.inf) -> float:
        """Return the expected number of maxima of one scan above a threshold.

        Args:
            threshold_sigma: threshold in (estimated) standard deviations of the answer.
            dof: degrees of freedom of the estimated variance; infinite: it is known.
        """
        if np.isinf(dof):
            return float(np.exp(self.log_expected_above(min(threshold_sigma, _HIGHEST))))
        # The ratio of estimated and true deviation by quadrature over what matters of it.
        reach = 8.0 / np.sqrt(2.0 * dof)
        node, weight = np.polynomial.legendre.leggauss(_NODES)
        ratio = 1.0 + reach * node
        ratio, weight = ratio[ratio > 0.0], weight[ratio > 0.0]
        probability = chi2.pdf(dof * ratio**2, dof) * 2.0 * dof * ratio * reach * weight
        numbers = np.exp(self.log_expected_above(np.minimum(threshold_sigma * ratio, _HIGHEST)))
        return float((probability * numbers).sum() / probability.sum())

    def threshold_sigma(self, per_line: float, dof: float = np.inf) -> float:
        """Return the threshold for an expected number of false alarms per scan.

        Args:
            per_line: expected number of false alarms in an empty scan.
            dof: as of ``expected``.

        Raises:
            InvalidParameter: a number that is not positive, or that no threshold from 0 to 12
                deviations gives.
        """
        low, high = (self.expected(t, dof) for t in (_HIGHEST, 0.0))
        if not low < per_line < high:
            raise InvalidParameter(
                f"false_alarms_per_line is {per_line}; on scans of {self.pixels} pixels it must "
                f"lie between {low:.3g} and {high:.3g}",
                false_alarms_per_line=per_line,
            )
        goal = np.log(per_line)
        return float(
            brentq(lambda t: np.log(self.expected(t, dof)) - goal, 0.0, _HIGHEST, xtol=1e-9)
        )


def _density(rows: Array, index: int, height: Array) -> Array:
    """Return the expected maxima at a place per unit of height, at heights of the answer."""
    selected = rows[index]
    norm = float(np.sqrt(selected @ selected))
    z = height / norm
    probability = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi) / norm
    sides = [row for row in (index - 1, index + 1) if 0 <= row < len(rows)]
    cosines, limits = [], []
    for row in sides:
        other = rows[row]
        size = float(np.sqrt(other @ other))
        cosine = float(selected @ other) / (norm * size)
        cosines.append(cosine)
        limits.append((height / size - cosine * z) / np.sqrt(1.0 - cosine**2))
    if len(sides) == 1:
        return np.asarray(probability * ndtr(limits[0]))
    before, after = rows[index - 1], rows[index + 1]
    across = float(before @ after) / float(np.sqrt((before @ before) * (after @ after)))
    rest = (across - cosines[0] * cosines[1]) / float(
        np.sqrt((1.0 - cosines[0] ** 2) * (1.0 - cosines[1] ** 2))
    )
    return np.asarray(probability * _both_below(limits[0], limits[1], rest))


def _both_below(h: Array, k: Array, rho: float) -> Array:
    """Return P(X < h, Y < k) of standard normal X, Y with a correlation, by Owen's T."""
    # At h or k = 0 the arguments are limits; a hair's breadth beside them is as good.
    h, k = (np.where(abs(v) < 1e-12, 1e-12, v) for v in (h, k))
    root = np.sqrt(1.0 - rho**2)
    total = 0.5 * (ndtr(h) + ndtr(k))
    total -= owens_t(h, (k / h - rho) / root) + owens_t(k, (h / k - rho) / root)
    return np.asarray(total - np.where(h * k < 0.0, 0.5, 0.0))
