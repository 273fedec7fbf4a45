"""Bundle adjustment by Levenberg-Marquardt; poses are eliminated in each step."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import (
    AdjustmentResult,
    assemble_result,
)
from compute.calibration.bundle_adjustment.gauge import orthogonal_complement, rigid_motion_jacobian
from compute.calibration.bundle_adjustment.normal_equations import (
    HUBER_LIMIT,
    AdjustmentState,
    NormalEquations,
    build_normal_equations,
    loss_weights,
    robust_scale,
    total_loss,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.settings import Loss
from compute.camera.model import SensorModel
from compute.errors import InvalidParameter, NoConvergence
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

MAX_ITERATIONS: Final = 200
CONVERGENCE_TOLERANCE: Final = 1e-9
"""Predicted decrease of chi2 below which the search ends: the step is then shorter than 3e-5
standard deviations."""
ROUNDING_TOLERANCE: Final = 1e-13
"""The same, relative to chi2, for rounding."""
SCALE_TOLERANCE: Final = 1e-3
"""The same for the stages of a robust loss with a wider limit."""
ROBUST_TOLERANCE: Final = 1e-6
"""The same for its own limit: reweighting ends slowly where poses hold several wrong readings."""
COARSE_TOLERANCE: Final = 1e-2
COARSE_STEPS: Final = 60
RELATIVE_OFFSET_TOLERANCE: Final = 1e-4
"""Decrease of chi2 for each global parameter that an undamped step predicts, below which a search
that comes no further has converged: a hundredth of a standard deviation."""
FINAL_DECREASE: Final = 0.1
"""The same for all parameters together when all steps are spent: a third of a standard deviation,
as of calibrations with control points. Curved valleys of nearly ambiguous poses have no end."""
UNDAMPED_THRESHOLD: Final = 1e-3
"""Largest damping at which the predicted decrease measures the distance to the minimum."""
POSE_REFIT_ITERATIONS: Final = 40
"""Trial steps after which each step also refits the poses to the sensors: a search that takes so
long follows a curved valley of nearly ambiguous poses (inner iterations: Ruhe and Wedin,
doi:10.1137/1022057)."""
POSE_REFIT_STEPS: Final = 3
POSE_REFIT_DAMPING: Final = 1e-3
MAX_DAMPING: Final = 1e14
"""Damping at which no step decreases the loss."""


def adjust(
    models: Sequence[SensorModel],
    pose_sets: Sequence[PoseSet],
    *,
    prior: SensorPrior | None = None,
    free: NDArray[np.bool_] | None = None,
    free_datum: bool = False,
    loss: Loss = "linear",
    max_iterations: int = MAX_ITERATIONS,
    progress: Progress = no_progress,
) -> AdjustmentResult:
    """Adjust sensors, shapes and poses to the readings.

    The world frame comes from known positions or from the prior. With ``free_datum`` nothing fixes
    it: the solution's frame is arbitrary, to be chosen by the caller, and the covariance is that of
    ``gauge.inner_constraints``.

    Args:
        models: the starting cameras, without a cubic term.
        pose_sets: the starting poses, with their readings.
        prior: of the sensors' parameters.
        free: which of the sensors' parameters are adjusted, shape (P,); None: all.
        free_datum: nothing fixes the world frame.
        loss: "linear", least squares, or "robust", Huber's loss.
        max_iterations: largest number of trial steps.
        progress: called with the fraction done and the stage.

    Raises:
        InvalidParameter: shapes that do not fit, or a cubic term.
        NoConvergence: an observed marker starts behind a lens, or the search does not converge.
        UndeterminedParameters: more than one solution fits.
    """
    state, adjusted_parameters = _check_inputs(models, pose_sets)
    if free is not None:
        count = sum(model.parameter_count for model in state.models)
        if free.shape != (count,):
            raise InvalidParameter(f"free has shape {free.shape}; it must be ({count},)")
        adjusted_parameters[:count] = free
    if free_datum and not adjusted_parameters.all():
        raise InvalidParameter("a free frame needs all parameters free; held ones fix the frame")
    search = _Search(state, prior, adjusted_parameters, progress, max_iterations, free_datum)
    limit = HUBER_LIMIT if loss == "robust" else np.inf
    try:
        search.run_stages(loss, 0.0)
    except NoConvergence:
        # Undetermined parameters explain the failure better.
        search.result(limit)
        raise
    return search.result(limit)


def approximate_solution(
    models: Sequence[SensorModel],
    pose_sets: Sequence[PoseSet],
    *,
    prior: SensorPrior | None = None,
    free_datum: bool = False,
    loss: Loss = "linear",
    steps: int = COARSE_STEPS,
) -> AdjustmentState:
    """Approach a solution from a bad start: ``adjust`` with early termination.

    It ends when a step predicts a decrease of less than a hundredth of chi2, or after ``steps``.
    The solution need not be determined.

    Args:
        models: the starting cameras, without a cubic term.
        pose_sets: the starting poses, with their readings.
        prior: of the sensors' parameters.
        free_datum: nothing fixes the world frame.
        loss: "linear" or "robust".
        steps: largest number of trial steps.

    Raises:
        InvalidParameter, NoConvergence: as ``adjust``, for the start.
    """
    state, every = _check_inputs(models, pose_sets)
    search = _Search(state, prior, every, no_progress, steps, free_datum)
    with suppress(NoConvergence):
        search.run_stages(loss, COARSE_TOLERANCE)
    return search.state


@dataclass(eq=False)
class _Search:
    """Levenberg-Marquardt search: its state, residuals and number of iterations."""

    state: AdjustmentState
    prior: SensorPrior | None
    adjusted_parameters: NDArray[np.bool_]
    progress: Progress
    max_iterations: int
    free_datum: bool
    iterations: int = 0

    def __post_init__(self) -> None:
        self.residuals = self.state.residuals()
        for number, residual in enumerate(self.residuals):
            if np.isnan(residual).any():
                pose, marker, sensor = np.argwhere(np.isnan(residual))[0]
                raise NoConvergence(
                    f"marker {marker + 1} of pose {pose + 1} (set {number + 1}) starts behind "
                    f"sensor {self.state.models[sensor].name}, which has read it; start nearer",
                    sensor=self.state.models[sensor].name,
                    pose=int(pose) + 1,
                )

    def result(self, limit: float) -> AdjustmentResult:
        """Return the current state with its covariance.

        Raises:
            UndeterminedParameters: the readings do not determine it.
        """
        return assemble_result(
            self.state,
            self.residuals,
            self.prior,
            self.adjusted_parameters,
            limit=limit,
            free_datum=self.free_datum,
            iterations=self.iterations,
        )

    def run_stages(self, loss: Loss, tolerance: float) -> None:
        """Minimise the loss; a robust one from a wide limit to its own."""
        if loss == "linear":
            self.minimise(np.inf, tolerance)
            return
        # Far from the minimum all residuals are large, and outliers are not yet distinguishable.
        scale = robust_scale(self.state, self.residuals)
        while scale > 1.0:
            self.minimise(HUBER_LIMIT * scale, max(tolerance, SCALE_TOLERANCE))
            scale = min(robust_scale(self.state, self.residuals), scale / 1.5)
        self.minimise(HUBER_LIMIT, max(tolerance, ROBUST_TOLERANCE))

    def minimise(self, limit: float, tolerance: float) -> None:
        """Iterate until a step predicts a relative decrease of less than ``tolerance``.

        Raises:
            NoConvergence: ``max_iterations`` steps did not get there, or no step makes the loss
                smaller.
        """
        damping = 1e-4
        loss = total_loss(self.state, self.residuals, self.prior, limit)
        while True:
            weights = loss_weights(self.residuals, limit)
            equations = build_normal_equations(self.state, weights, self.prior)
            # A weak prior of the frame would slowly rotate the whole world, by linear steps on a
            # curved path.
            motion = None
            if self.free_datum:
                motion = rigid_motion_jacobian(self.state.models, len(self.adjusted_parameters))
            while True:
                self.progress(min(self.iterations / self.max_iterations, 1.0), "adjustment")
                if self.iterations >= self.max_iterations:
                    if self._is_near_minimum(equations, motion, FINAL_DECREASE):
                        return
                    raise NoConvergence(
                        f"the adjustment has not converged after {self.iterations} steps "
                        f"(chi2 {loss:.6g}); start nearer, or look for wrong readings"
                    )
                self.iterations += 1
                reduced = equations.reduced(damping)
                step = np.zeros(len(self.adjusted_parameters))
                step[self.adjusted_parameters] = _solve_damped(
                    reduced.normal[np.ix_(self.adjusted_parameters, self.adjusted_parameters)],
                    -reduced.gradient[self.adjusted_parameters],
                    motion,
                )
                local = reduced.local_steps(equations, step)
                predicted = -float(equations.gradient @ step) - sum(
                    float((block.gradient * one).sum())
                    for block, one in zip(equations.blocks, local, strict=True)
                )
                trial = self.state.retract(step, local)
                new = np.inf
                if all(model.principal_distance_px > 0.0 for model in trial.models):
                    residuals = trial.residuals()
                    new = total_loss(trial, residuals, self.prior, limit)
                    if self.iterations > POSE_REFIT_ITERATIONS and np.isfinite(new):
                        trial, residuals, new = self._refit_poses(trial, residuals, new, limit)
                # NaN, a point behind a lens, is not better; nor is the same loss, to which steps at
                # the minimum round.
                better = new < loss
                ending = (
                    damping <= UNDAMPED_THRESHOLD
                    and predicted <= CONVERGENCE_TOLERANCE + (tolerance + ROUNDING_TOLERANCE) * loss
                )
                if better:
                    # A smaller decrease than predicted: the problem is curved, shorten the steps.
                    gain_ratio = (loss - new) / predicted if predicted > 0.0 else 1.0
                    damping *= 0.1 if gain_ratio > 0.75 else 1.0 if gain_ratio > 0.25 else 3.0
                    damping = max(damping, 1e-12)
                    self.state, self.residuals, loss = trial, residuals, new
                    break
                if ending:
                    break
                damping *= 10.0
                if damping > MAX_DAMPING:
                    if self._is_near_minimum(equations, motion):
                        return
                    raise NoConvergence(
                        f"the adjustment is stuck at chi2 {loss:.6g}: no step makes it smaller; "
                        "start nearer, or look for wrong readings"
                    )
            if ending:
                return

    def _refit_poses(
        self, state: AdjustmentState, residuals: list[Array], loss: float, limit: float
    ) -> tuple[AdjustmentState, list[Array], float]:
        """Refit poses with the sensors held, as long as that makes the loss smaller."""
        for _ in range(POSE_REFIT_STEPS):
            equations = build_normal_equations(state, loss_weights(residuals, limit), self.prior)
            no_step = np.zeros(len(self.adjusted_parameters))
            local = equations.reduced(POSE_REFIT_DAMPING).local_steps(equations, no_step)
            trial = state.retract(no_step, local)
            trial_residuals = trial.residuals()
            new = total_loss(trial, trial_residuals, self.prior, limit)
            if not new < loss:  # NaN: a point behind a lens
                break
            state, residuals, loss = trial, trial_residuals, new
        return state, residuals, loss

    def _is_near_minimum(
        self, equations: NormalEquations, motion: Array | None, max_decrease: float = 0.0
    ) -> bool:
        """Return whether the undamped step is negligible (Bates and Watts, doi:10.2307/1268140).

        Args:
            equations: at the current state.
            motion: Jacobian of rigid motions; None: the frame is fixed.
            max_decrease: decrease of chi2 that is negligible in any case.
        """
        free = self.adjusted_parameters
        try:
            reduced = equations.reduced()
        except np.linalg.LinAlgError:  # a pose that nothing determines
            return False
        normal = reduced.normal[np.ix_(free, free)]
        if not (np.diagonal(normal) > 0.0).all():  # a parameter that nothing determines
            return False
        gradient = reduced.gradient[free]
        step = _solve_damped(normal, -gradient, motion)
        poses = sum(
            float(np.einsum("bi,bij,bj->", block.gradient, inverse, block.gradient))
            for block, inverse in zip(equations.blocks, reduced.inverses, strict=True)
        )
        limit = max(RELATIVE_OFFSET_TOLERANCE * len(gradient), max_decrease)
        return 0.0 <= poses - float(gradient @ step) <= limit


def _check_inputs(
    models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]
) -> tuple[AdjustmentState, NDArray[np.bool_]]:
    """Return the starting state, and a mask that adjusts all its globals.

    Raises:
        InvalidParameter: a camera has a cubic term, or a set has readings of another number of
            sensors.
    """
    for model in models:
        if model.cubic_per_px2 != 0.0:
            raise InvalidParameter(
                f"sensor {model.name} has the cubic term {model.cubic_per_px2:g}; "
                "only metric cameras are adjusted",
                sensor=model.name,
            )
    for number, poses in enumerate(pose_sets):
        if poses.readings_px.shape[-1] != len(models):
            raise InvalidParameter(
                f"set {number + 1} has readings of {poses.readings_px.shape[-1]} sensors; "
                f"there are {len(models)}"
            )
    count = sum(model.parameter_count for model in models)
    count += sum(poses.shape.unknowns for poses in pose_sets)
    return AdjustmentState(tuple(models), tuple(pose_sets)), np.ones(count, dtype=np.bool_)


def _solve_damped(normal: Array, right: Array, motion: Array | None) -> Array:
    """Solve the damped equations, scaled to a unit diagonal, without rigid motions (F, 6).

    No step where they are singular or have overflowed.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), np.finfo(np.float64).tiny))
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = normal * scale[:, None] * scale
    if not np.isfinite(scaled).all():
        return np.zeros_like(right)
    try:
        if motion is None:
            step = scale * np.linalg.solve(scaled, scale * right)
        else:
            basis = orthogonal_complement(motion / scale[:, None])
            inner = np.linalg.solve(basis.T @ scaled @ basis, basis.T @ (scale * right))
            step = scale * (basis @ inner)
    except np.linalg.LinAlgError:
        return np.zeros_like(right)
    return np.asarray(step if np.isfinite(step).all() else np.zeros_like(right), dtype=np.float64)
