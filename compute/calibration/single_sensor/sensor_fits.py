"""Control points with their readings, and the cameras fitted to them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.camera_fit import (
    MinimisationResult,
    minimise,
    minimise_with_distortion,
)
from compute.calibration.single_sensor.design_matrix import (
    EquationGroup,
    check_determined,
    equation_groups,
)
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import NoConvergence

Array = NDArray[np.float64]

SIGMA_FLOOR_PX: Final = 1e-6
"""Smallest standard deviation estimated from residuals: exact data still leave rounding."""


@dataclass(frozen=True, eq=False)
class ControlObservations:
    """Checked control points and their readings.

    Args:
        points_mm: shape (N, 3).
        readings_px: shape (N, S); NaN where not seen.
        sigma_px: standard deviations of the readings, shape (N, S); ones where not known.
        sigma_known: whether they are known.
        sensors: the S sensors.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sigma_known: bool
    sensors: tuple[SensorGeometry, ...]

    @classmethod
    def of(
        cls,
        points_mm: Array,
        readings_px: Array,
        sensors: Sequence[SensorGeometry],
        sigma_px: Array | None,
    ) -> "ControlObservations":
        """Return observations whose standard deviations may be unknown.

        Args:
            points_mm: shape (N, 3) [mm].
            readings_px: shape (N, S) [px]; NaN where not seen.
            sensors: the S sensors.
            sigma_px: standard deviations of the readings, shape (N, S) [px]; None: not known.
        """
        sigma = 1.0 if sigma_px is None else np.where(np.isfinite(readings_px), sigma_px, 1.0)
        wide = np.broadcast_to(sigma, readings_px.shape)
        return cls(points_mm, readings_px, wide, sigma_px is not None, tuple(sensors))

    def with_point_sigma(
        self, models: Sequence[SensorModel], position_sigma_mm: float
    ) -> "ControlObservations":
        """Add the control points' uncertainty to the readings' standard deviations.

        Args:
            models: the S cameras.
            position_sigma_mm: standard deviation of each coordinate [mm].
        """
        point_sigma = projected_point_sigma(models, self.points_mm, position_sigma_mm)
        return replace(self, sigma_px=np.hypot(self.sigma_px, np.nan_to_num(point_sigma)))

    def residuals_px(self, models: Sequence[SensorModel] | CameraStack) -> Array:
        """Return readings of S cameras minus measured ones, shape (N, S) [px]."""
        stack = models if isinstance(models, CameraStack) else CameraStack.of(models)
        return stack.project(self.points_mm) - self.readings_px

    @property
    def observed_mask(self) -> NDArray[np.bool_]:
        """Mask of the readings that were measured, shape (N, S)."""
        return np.isfinite(self.readings_px)

    @property
    def weights(self) -> Array:
        """1 / standard deviation, 0 where not seen, shape (N, S)."""
        return np.where(self.observed_mask, 1.0 / self.sigma_px, 0.0)

    @property
    def pitch_um(self) -> list[float | None]:
        """The sensors' pixel pitches [um]."""
        return [sensor.pitch_um for sensor in self.sensors]


@dataclass(frozen=True, eq=False)
class SensorFits:
    """Fitted cameras.

    Args:
        models: the S cameras.
        weights: of the readings by a robust loss, shape (N, S); ones with a linear loss.
        prior: of the lenses; without effect on cameras without distortion.
        unit_px: the noise that a weight of 1 stands for, where the readings' standard deviations
            are not known, shape (S,) [px]; None: 1.
        groups: the equations of the readings that count, where they were made; None: not yet.
        stack: the cameras as a stack, likewise.
    """

    models: tuple[SensorModel, ...]
    weights: Array
    prior: LensPrior
    unit_px: Array | None = None
    groups: list[EquationGroup] | None = None
    stack: CameraStack | None = None

    @property
    def scaled_prior(self) -> LensPrior:
        """The prior in the units of the readings' weights."""
        return self.prior if self.unit_px is None else self.prior.scaled(self.unit_px)

    def used(self, observed: ControlObservations) -> NDArray[np.bool_]:
        """Return which readings count, shape (N, S)."""
        return observed.observed_mask & (self.weights > 0.0)

    def known_weights(self, observed: ControlObservations) -> Array:
        """Return 1 / standard deviation of the readings that count, 0 of others, (N, S) [1/px]."""
        return np.where(self.weights > 0.0, observed.weights, 0.0)

    def equation_groups(self, observed: ControlObservations) -> list[EquationGroup]:
        """Return the equations of the readings that count."""
        if self.groups is not None:
            return self.groups
        weights = self.known_weights(observed)
        return equation_groups(self.models, observed.points_mm, weights, self.scaled_prior)

    def fit_without(
        self, observed: ControlObservations, subsets: NDArray[np.bool_]
    ) -> MinimisationResult:
        """Refit all cameras to parts of the points, starting from these.

        Args:
            observed: control points and readings.
            subsets: points of each part, shape (G, N).

        Returns:
            G S cameras, the first part's first.
        """
        sensors = len(self.models)
        index = np.tile(np.arange(sensors), len(subsets))
        weights = (observed.weights * np.sqrt(self.weights))[:, index]
        return minimise_with_distortion(
            CameraStack.of(self.models).rows(index),
            observed.points_mm,
            observed.readings_px[:, index],
            weights * np.repeat(subsets, sensors, axis=0).T,
            self.scaled_prior.rows(index),
            multi_start=False,
        )


def residual_sigma(
    observed: ControlObservations, models: Sequence[SensorModel], weights: Array
) -> Array:
    """Estimate each sensor's reading noise from its residuals.

    Args:
        observed: control points and readings.
        models: the S fitted cameras.
        weights: of the readings, shape (N, S); 0: left out.

    Returns:
        Standard deviations, shape (S,) [px].
    """
    sigma = []
    for model, column, weight in zip(
        models, observed.residuals_px(models).T, weights.T, strict=True
    ):
        rows = np.isfinite(column) & (weight > 0.0)
        dof = max(int(rows.sum()) - PARAMETER_COUNT - len(model.terms), 1)
        sigma.append(max(float(np.sqrt((column[rows] ** 2).sum() / dof)), SIGMA_FLOOR_PX))
    return np.array(sigma)


def projected_point_sigma(
    models: Sequence[SensorModel], points_mm: Array, sigma_mm: float
) -> Array:
    """Project the control points' uncertainty onto the readings.

    Args:
        models: S cameras.
        points_mm: control points, shape (N, 3) [mm].
        sigma_mm: standard deviation of each coordinate [mm].

    Returns:
        Standard deviations of the readings due to the points, shape (N, S) [px].
    """
    jacobian = CameraStack.of(models).linearise(points_mm)[1]
    return np.asarray(sigma_mm * np.linalg.norm(jacobian, axis=2))


def refit(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    prior: LensPrior | None,
    weights: Array,
    multi_start: bool = True,
) -> tuple[SensorModel, ...]:
    """Return cameras at the minimum near their starts.

    Args:
        observed: control points and readings.
        starts: S cameras with their terms.
        prior: of the lenses; None: none.
        weights: of the readings, shape (N, S) [1/px]; 0: left out.
        multi_start: see ``minimise_with_distortion``.

    Raises:
        DegeneratePoints: a combination of parameters is undetermined.
        NoConvergence: a search did not converge.
    """
    stack = CameraStack.of(starts)
    problem = stack, observed.points_mm, observed.readings_px, weights
    if prior is None or not stack.has_distortion:
        solution = minimise(*problem)
    else:
        solution = minimise_with_distortion(*problem, prior, multi_start=multi_start)
    models = solution.cameras.models(starts)
    if not solution.converged.all():
        # Undetermined parameters explain the failure better than "did not converge".
        used = np.where(weights > 0.0, observed.weights, 0.0)
        check_determined(models, observed.points_mm, used, prior)
    check_converged(observed, starts, solution.converged)
    return models


def check_converged(
    observed: ControlObservations, starts: Sequence[SensorModel], converged: NDArray[np.bool_]
) -> None:
    """Check that the search for each camera with distortion converged.

    Args:
        observed: control points and readings.
        starts: the S starting cameras with their terms.
        converged: whether each search converged, shape (S,).

    Raises:
        NoConvergence: the first that did not.
    """
    for column in np.flatnonzero(~converged).tolist():
        name = observed.sensors[column].name
        raise NoConvergence(
            f"sensor {name}: the search for its {PARAMETER_COUNT} parameters and "
            f"{len(starts[column].terms)} distortion terms did not converge with its "
            f"{int(observed.observed_mask[:, column].sum())} readings; spread the points over the "
            "field and in depth, take fewer terms, or look for wrong labels",
            sensor=name,
        )
