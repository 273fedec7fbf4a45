"""Helpers that build metric families: gauge, counter, histogram."""

from collections.abc import Iterable, Mapping

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
)

Labelled = Iterable[tuple[tuple[str, ...], float]]
"""Values, each behind those of its labels."""


def counter(
    name: str, text: str, values: Labelled, labels: tuple[str, ...] = ("device",)
) -> CounterMetricFamily:
    """Return a counter; ``name`` without the ``_total`` that it gets."""
    family = CounterMetricFamily(f"lumiline_{name}", text, labels=labels)
    for label, value in values:
        family.add_metric(label, value)
    return family


def gauge(
    name: str, text: str, values: Labelled, labels: tuple[str, ...] = ("device",)
) -> GaugeMetricFamily:
    """Return a gauge."""
    family = GaugeMetricFamily(f"lumiline_{name}", text, labels=labels)
    for label, value in values:
        family.add_metric(label, value)
    return family


def single(name: str, text: str, value: float) -> GaugeMetricFamily:
    """Return a gauge of one value, without labels."""
    return GaugeMetricFamily(f"lumiline_{name}", text, value=value)


def histogram(
    name: str,
    text: str,
    labels: tuple[str, ...],
    bounds: tuple[float, ...],
    values: Mapping[tuple[str, ...], tuple[tuple[int, ...], float]],
) -> HistogramMetricFamily:
    """Return a histogram.

    Args:
        name: of it, with its unit.
        text: what it is of.
        labels: their names.
        bounds: upper bounds of the classes but the last, which has none.
        values: by labels, the counts of each class and the sum of all.
    """
    family = HistogramMetricFamily(f"lumiline_{name}", text, labels=labels)
    edges = (*(repr(bound) for bound in bounds), "+Inf")
    for label, (counts, total) in values.items():
        buckets, running = [], 0
        for edge, count in zip(edges, counts, strict=True):
            running += count
            buckets.append((edge, float(running)))
        family.add_metric(label, buckets, total)
    return family
