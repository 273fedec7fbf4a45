"""Check that a marker was moved between two targets: their readings must differ."""

from collections.abc import Sequence
from typing import Final

from scipy.stats import chi2

from service.api.captures.schema import CapturedTarget
from service.problems.errors import MarkerNotMoved

MIN_POINT_DISTANCE_MM: Final = 0.1
"""Targets nearer than this may be read the same."""
_MIN_SENSORS: Final = 3
_FALSE_ALARM_PROBABILITY: Final = 1e-4
"""That a marker still at rest is not noticed, for its noise alone."""
_FLOOR_PX: Final = 0.01
"""Deviation of a mean that noise does not show: how a marker settles."""


def check_marker_moved(found: CapturedTarget, others: Sequence[CapturedTarget]) -> None:
    """Check that a target's readings are not those of another.

    Sensors that see only one of the two say nothing; at least three must see both.

    Args:
        found: what was read of the target.
        others: what was read of targets elsewhere, in order.

    Raises:
        MarkerNotMoved: in all sensors that saw both, another was read the same within the noise.
    """
    now = {one.sensor: one for one in found.sensors}
    for other in reversed(others):
        if other.target == found.target:
            continue
        pairs = [(now[one.sensor], one) for one in other.sensors if one.sensor in now]
        if len(pairs) < _MIN_SENSORS:
            continue
        squares = [
            (one.mean_px - before.mean_px) ** 2
            / (one.sigma_px**2 + before.sigma_px**2 + _FLOOR_PX**2)
            for one, before in pairs
        ]
        if sum(squares) <= float(chi2.isf(_FALSE_ALARM_PROBABILITY, len(pairs))):
            largest = max(abs(one.mean_px - before.mean_px) for one, before in pairs)
            raise MarkerNotMoved(
                f'target "{found.target}" reads as target "{other.target}" does, within '
                f"{largest:.2g} px in all {len(pairs)} sensors that see both: is the marker still "
                f'at "{other.target}"? Move it and capture again; of strobed markers name each '
                "target's own",
                target=found.target,
                other=other.target,
                largest_px=largest,
            )
