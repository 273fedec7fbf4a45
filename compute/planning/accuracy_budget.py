"""Accuracy budget of a plan: contributions combined over the volume, and the dominant one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.planning.budget_inputs import BudgetInputs
from compute.planning.error_contributions import ErrorContribution
from compute.planning.plan_result import AccuracyBudget, AxisSummary, BudgetContribution

Array = NDArray[np.float64]


def combined_sigma(contributions: Sequence[ErrorContribution]) -> Array:
    """Return the root sum of squares of the contributions that count, shape (N, 3) [mm].

    The sources are independent of each other: GUM (JCGM 100), 5.1.2.

    Args:
        contributions: at the same N points, at least one that is counted.
    """
    counted = [np.square(one.sigma_mm) for one in contributions if one.counted]
    total: Array = np.sqrt(np.sum(counted, axis=0))
    return total


def accuracy_budget(
    contributions: Sequence[ErrorContribution],
    inputs: BudgetInputs,
    distance_mm: Array,
    centre: int,
) -> AccuracyBudget | None:
    """Summarise contributions over the volume.

    Args:
        contributions: of all sources, at the same N points.
        inputs: what they depend on.
        distance_mm: Z of the points, shape (N,) [mm].
        centre: index of the point nearest to the volume's centre.

    Returns:
        None where no point has a position.
    """
    total = combined_sigma(contributions)
    finite = np.isfinite(total).all(axis=1)
    if not finite.any():
        return None
    distances = np.unique(distance_mm[finite])

    def rms(values: Array) -> float:
        return float(np.sqrt(np.square(values[finite]).sum(axis=1).mean()))

    def by_distance(values: Array) -> tuple[float, ...]:
        squares = np.square(values).sum(axis=1)
        planes = [squares[finite & (distance_mm == one)] for one in distances]
        return tuple(float(np.sqrt(plane.mean())) for plane in planes)

    total_rms = rms(total)
    listed = tuple(
        BudgetContribution(
            one.name,
            one.kind,
            one.counted,
            inputs.assumed(one.inputs),
            tuple(inputs.label(name) for name in one.inputs),
            AxisSummary.of(one.sigma_mm, centre),
            rms(one.sigma_mm),
            by_distance(one.sigma_mm),
            (rms(one.sigma_mm) / total_rms) ** 2 if one.counted else 0.0,
        )
        for one in contributions
    )
    by_kind = {
        kind: combined_sigma([one for one in contributions if one.kind == kind])
        for kind in ("random", "systematic")
    }
    return AccuracyBudget(
        listed,
        max(listed, key=lambda one: one.share).name,
        AxisSummary.of(by_kind["random"], centre),
        AxisSummary.of(by_kind["systematic"], centre),
        AxisSummary.of(total, centre),
        total_rms,
        tuple(distances.tolist()),
        by_distance(total),
        tuple(inputs.by_field.values()),
    )
