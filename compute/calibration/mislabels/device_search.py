"""Label exchanges common to all sensors: two control points with exchanged labels."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, exp, log
from typing import Final

from compute.calibration.mislabels.evaluation import SensorReadings, evaluate
from compute.calibration.mislabels.hypothesis import log_exchange_prior
from compute.calibration.mislabels.sensor_search import SensorExplanation, search_sensor_labels

COMMON_EXCHANGE_PROBABILITY: Final = 0.02
"""That two points have each other's labels in all sensors, before looking."""


SEARCH_MARGIN: Final = 12.0
"""Below what is needed by this much, an exchange of points is not searched for."""


@dataclass(frozen=True, eq=False)
class DeviceExchange:
    """Two points, counted from 0, with exchanged labels, and its probability."""

    pair: tuple[int, int]
    probability: float


@dataclass(frozen=True, eq=False)
class DeviceExplanation:
    """Label errors of all sensors, and each sensor's own once those are repaired."""

    common: tuple[DeviceExchange, ...]
    readings: tuple[SensorReadings, ...]
    sensors: tuple[SensorExplanation, ...]


def search_device(
    readings: Sequence[SensorReadings], found: Sequence[SensorExplanation]
) -> DeviceExplanation:
    """Find exchanges that are likelier for the points than for single sensors.

    Args:
        readings: of each sensor, of the same points.
        found: what a search of each by itself found.
    """
    now, found = list(readings), list(found)
    common: list[DeviceExchange] = []
    refused: set[tuple[int, int]] = set()
    while True:
        pair = next((p for p in _exchanged_pairs(found) if p not in refused), None)
        if pair is None:
            return DeviceExplanation(tuple(common), tuple(now), tuple(found))
        refused.add(pair)
        prior = log(COMMON_EXCHANGE_PROBABILITY / comb(len(now[0].points_mm), 2))
        expected_gain = prior + sum(
            _expected_gain(*each, pair) for each in zip(now, found, strict=True)
        )
        if expected_gain < -SEARCH_MARGIN:
            continue
        swapped = [one.exchanged(*pair) for one in now]
        after = [search_sensor_labels(one) for one in swapped]
        gain = prior + sum(
            new.best.log_posterior - old.best.log_posterior
            for new, old in zip(after, found, strict=True)
        )
        if gain > 0.0:
            common.append(DeviceExchange(pair, 1.0 / (1.0 + exp(-min(gain, 700.0)))))
            now, found = swapped, after


def _expected_gain(data: SensorReadings, labels: SensorExplanation, pair: tuple[int, int]) -> float:
    """Return the approximate gain of a sensor's best hypothesis when two points are exchanged."""
    best = labels.best
    own = log_exchange_prior(len(data.seen))
    if pair in best.hypothesis.cycles:
        return -own
    if best.hypothesis.affected_points & set(pair):
        return SEARCH_MARGIN  # Its errors are mixed up with the pair: only a search can tell.
    evaluated = evaluate(data, [best.hypothesis.with_cycle(pair)], best.theta)
    return max(own, evaluated[0].log_posterior - own - best.log_posterior if evaluated else own)


def _exchanged_pairs(found: Sequence[SensorExplanation]) -> list[tuple[int, int]]:
    """Return the pairs exchanged in any sensor, those in most sensors first."""
    counted: dict[tuple[int, int], int] = {}
    for labels in found:
        for cycle in sorted(labels.best.hypothesis.cycles):
            if len(cycle) == 2:
                pair = (cycle[0], cycle[1])
                counted[pair] = counted.get(pair, 0) + 1
    return sorted(counted, key=lambda pair: (-counted[pair], pair))
