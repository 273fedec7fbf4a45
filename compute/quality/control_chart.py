"""Control chart: Shewhart and EWMA charts of individual values.

A Shewhart chart of individual values, with sigma from their moving range, detects a jump; an
exponentially weighted moving average detects a slow drift that no single value shows (D. C.
Montgomery, Introduction to Statistical Quality Control, chapters 6 and 9; S. W. Roberts,
Technometrics 1, 239, 1959, doi 10.1080/00401706.1959.10489860). The baseline has few values; the
limits are those of Student's distribution to allow for that.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

MIN_BASELINE: Final = 8
"""Smallest number of values in a baseline."""
_RANGE_OF_TWO: Final = 1.128379167095513
"""Mean range of two values over their standard deviation, 2 / sqrt(pi)."""
_SHEWHART_LIMIT: Final = 3.0
_EWMA_WEIGHT: Final = 0.2
_EWMA_LIMIT: Final = 2.86
"""With the weight 0.2 the average leaves its limits by chance as rarely as a value its own: once
in 370 (J. M. Lucas and M. S. Saccucci, Technometrics 32, 1, 1990, table 3)."""
_DOF_PER_VALUE: Final = 0.62
"""Degrees of freedom of a sigma from the moving range, for each value but the first."""
_SUSTAINED_JUMPS: Final = 3
_SUSTAINED_VALUES: Final = 8
_SUSTAINED_SIGNIFICANCE: Final = 1e-4
"""Significance of the shifted mean of that many values."""


class ControlChartAlarm(StrEnum):
    """Alarm raised by a value."""

    NONE = "none"
    JUMP = "jump"
    """It is where a value is by chance once in 370, as beyond three standard deviations."""
    DRIFT = "drift"
    """The weighted average of it and those before is beyond its limits."""


@dataclass(frozen=True, eq=False)
class ControlChart:
    """N values with their limits.

    Args:
        values: shape (N,).
        centre: mean of the baseline.
        sigma: standard deviation of a value, from the baseline's moving range, at least the floor.
        ewma: exponentially weighted moving average, shape (N,); the centre in the baseline.
        limit: largest distance of a value from the centre without an alarm.
        ewma_limit: largest distance of the average from the centre, shape (N,).
        alarms: one for each value; NONE in the baseline.
        baseline: number of values in the baseline; all values while they are fewer than that.
        ready: whether the baseline is complete; before, there are no alarms.
    """

    values: Array
    centre: float
    sigma: float
    ewma: Array
    limit: float
    ewma_limit: Array
    alarms: tuple[ControlChartAlarm, ...]
    baseline: int
    ready: bool

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit of a value."""
        return self.centre - self.limit, self.centre + self.limit

    @property
    def is_sustained(self) -> bool:
        """Whether the newest values confirm a change: three jumps, or a shifted mean of eight.

        Alarms of the average do not count: it has a memory, and one is followed by others.
        """
        judged = len(self.values) - self.baseline
        newest = set(self.alarms[-_SUSTAINED_JUMPS:])
        if self.ready and judged >= _SUSTAINED_JUMPS and newest == {ControlChartAlarm.JUMP}:
            return True
        if not self.ready or judged < _SUSTAINED_VALUES:
            return False
        off = abs(float(self.values[-_SUSTAINED_VALUES:].mean()) - self.centre)
        factor = _quantile(self.baseline, 1.0 - _SUSTAINED_SIGNIFICANCE / 2)
        return off > factor * self.sigma * math.sqrt(1 / _SUSTAINED_VALUES + 1 / self.baseline)


def control_chart(values: Array, baseline: int = 20, floor: float = 0.0) -> ControlChart:
    """Return the control chart of values in the order of time.

    Args:
        values: shape (N,).
        baseline: number of first values from which centre and sigma are estimated.
        floor: lower bound of sigma; without it, values that hardly scatter would raise an alarm at
            any change.

    Raises:
        InvalidParameter: a value is not finite, or the baseline too short.
    """
    if baseline < MIN_BASELINE:
        raise InvalidParameter(
            f"the baseline has {baseline} values; at least {MIN_BASELINE} say what is normal",
            baseline=baseline,
        )
    if not np.isfinite(values).all():
        raise InvalidParameter("a value of the chart is not a number; leave it out")
    used = min(baseline, len(values))
    first = values[:used]
    centre = float(first.mean()) if used else np.nan
    steps = np.abs(np.diff(first))
    sigma = max(float(steps.mean()) / _RANGE_OF_TWO if len(steps) else 0.0, floor)
    ready = used >= baseline
    ewma = np.full(len(values), centre)
    limit = np.zeros(len(values))
    single = several = 0.0
    if ready:
        single = _quantile(used, ndtr(_SHEWHART_LIMIT)) * sigma * np.sqrt(1 + 1 / used)
        several = _quantile(used, ndtr(_EWMA_LIMIT)) * sigma
    alarms = [ControlChartAlarm.NONE] * len(values)
    for index in range(used, len(values)):
        ewma[index] = (1 - _EWMA_WEIGHT) * ewma[index - 1] + _EWMA_WEIGHT * values[index]
        memory = 1 - (1 - _EWMA_WEIGHT) ** (2 * (index - used + 1))
        share = _EWMA_WEIGHT / (2 - _EWMA_WEIGHT) * memory
        limit[index] = several * np.sqrt(share + 1 / used)
        if abs(values[index] - centre) > single:
            alarms[index] = ControlChartAlarm.JUMP
        elif abs(ewma[index] - centre) > limit[index]:
            alarms[index] = ControlChartAlarm.DRIFT
    return ControlChart(
        values, centre, sigma, ewma, float(single), limit, tuple(alarms), used, ready
    )


def _quantile(baseline: int, probability: float) -> float:
    """Return Student's quantile for a sigma from the moving range of a baseline."""
    return float(stdtrit(_DOF_PER_VALUE * (baseline - 1), probability))
