"""adjust: Levenberg-Marquardt over sensors, shapes and poses, poses eliminated in each step."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.gauge import orthogonal_complement, rigid_motion_jacobian
from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    build_normal_equations,
)
from compute.calibration.bundle_adjustment.parameter_covariance import (
    check_poses,
    global_covariance,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.robust_loss import (
    HUBER_LIMIT,
    Loss,
    loss_weights,
    robust_scale,
    total_loss,
)
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.camera.model import SensorModel
from compute.errors import InvalidParameter, NoConvergence

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

MAX_ITERATIONS: Final = 200
CONVERGENCE_TOLERANCE: Final = 1e-9
"""Largest decrease of chi2 that a step may still promise at the end: its length is then less
than 3e-5 standard deviations."""
ROUNDING_TOLERANCE: Final = 1e-13
"""The same, relative to chi2: what its own rounding hides."""
SCALE_TOLERANCE: Final = 1e-3
"""The same for the stages of a robust loss with a wider limit."""
ROBUST_TOLERANCE: Final = 1e-6
"""The same for its own limit: reweighting ends slowly where poses hold several wrong readings."""
COARSE_TOLERANCE: Final = 1e-2
COARSE_STEPS: Final = 60
UNDAMPED_THRESHOLD: Final = 1e-3
"""Largest damping at which what a step promises tells how far the minimum is."""
MAX_DAMPING: Final = 1e14
"""Damping at which no step at all makes the sum smaller."""


def adjust(
    models: Sequence[SensorModel],
    pose_sets: Sequence[PoseSet],
    *,
    prior: SensorPrior | None = None,
    free: NDArray[np.bool_] | None = None,
    free_datum: bool = False,
    loss: Loss = "linear",
    max_iterations: int = MAX_ITERATIONS,
    progress: Progress | None = None,
) -> AdjustmentResult:
    """Fit sensors, shapes and poses to the readings, each over its standard deviation.

    The world frame must come from somewhere: from known positions, from the prior, or, with
    ``free_datum``, from what the caller makes of it afterwards: the solution's frame is any,
    and the covariance is that of ``gauge.inner_constraints``.

    Args:
        models: the sensors to start from, without a cubic term.
        pose_sets: poses to start from, with their readings.
        prior: what is known of the sensors.
        free: which of the sensors' parameters are adjusted, shape (P,); None: all.
        free_datum: nothing here knows the world's frame.
        loss: "linear", least squares, or "robust", Huber's loss.
        max_iterations: steps that are tried at most.
        progress: called with the fraction done and the stage; what it raises passes through.

    Raises:
        InvalidParameter: shapes that do not fit, or a cubic term.
        NoConvergence: a marker that was read starts behind a lens, or the steps do not settle.
        UndeterminedParameters: more than one solution fits.
    """
    state = _check_inputs(models, pose_sets)
    count = sum(model.parameter_count for model in state.models)
    shapes = sum(poses.shape.unknowns for poses in state.pose_sets)
    if free is not None and free.shape != (count,):
        raise InvalidParameter(f"free has shape {free.shape}; it must be ({count},)")
    adjusted_parameters = np.ones(count + shapes, dtype=np.bool_)
    if free is not None:
        adjusted_parameters[:count] = free
    if free_datum and not adjusted_parameters.all():
        raise InvalidParameter("a free frame needs all parameters free; held ones fix the frame")
    search = _Search(state, prior, adjusted_parameters, progress, max_iterations, free_datum)
    limit = HUBER_LIMIT if loss == "robust" else np.inf
    try:
        search.run_stages(loss, 0.0)
    except NoConvergence:
        # In a valley without an end no step settles: then the parameters are open, and named.
        _assemble_result(search, limit, free_datum)
        raise
    return _assemble_result(search, limit, free_datum)


def approximate_solution(
    models: Sequence[SensorModel],
    pose_sets: Sequence[PoseSet],
    *,
    prior: SensorPrior | None = None,
    free_datum: bool = False,
    loss: Loss = "linear",
    steps: int = COARSE_STEPS,
) -> AdjustmentState:
    """Come near a solution from a bad start: as ``adjust``, but it ends early, wherever it is.

    It ends when a step promises less than a hundredth of chi2, or after ``steps``; nothing says
    that what it has come to is determined.

    Raises:
        InvalidParameter, NoConvergence: as ``adjust``, for the start.
    """
    state = _check_inputs(models, pose_sets)
    count = sum(model.parameter_count for model in state.models)
    count += sum(poses.shape.unknowns for poses in state.pose_sets)
    search = _Search(state, prior, np.ones(count, dtype=np.bool_), None, steps, free_datum)
    with suppress(NoConvergence):
        search.run_stages(loss, COARSE_TOLERANCE)
    return search.state


@dataclass(eq=False)
class _Search:
    """The state of a search and its steps."""

    state: AdjustmentState
    prior: SensorPrior | None
    adjusted_parameters: NDArray[np.bool_]
    progress: Progress | None
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

    def run_stages(self, loss: Loss, tolerance: float) -> None:
        """Run with a loss; a robust one from a wide limit to its own."""
        if loss == "linear":
            self.run(np.inf, tolerance)
            return
        # Far from the minimum all residuals are large, and none says yet which is wrong.
        scale = robust_scale(self.state, self.residuals)
        while scale > 1.0:
            self.run(HUBER_LIMIT * scale, max(tolerance, SCALE_TOLERANCE))
            scale = min(robust_scale(self.state, self.residuals), scale / 1.5)
        self.run(HUBER_LIMIT, max(tolerance, ROBUST_TOLERANCE))

    def _motion(self) -> Array:
        """Return the globals' slopes by rigid motions of the world, shape (F, 6)."""
        jacobian = rigid_motion_jacobian(self.state.models)
        motion = np.zeros((len(self.adjusted_parameters), 6))
        motion[: len(jacobian)] = jacobian
        return motion

    def run(self, limit: float, tolerance: float) -> None:
        """Step until the next one promises less than a share ``tolerance`` of the loss."""
        damping = 1e-4
        loss = total_loss(self.state, self.residuals, self.prior, limit)
        while True:
            weights = loss_weights(self.residuals, limit)
            equations = build_normal_equations(self.state, weights, self.prior)
            # A prior that knows the frame a little would turn the whole world in the end, by
            # steps that are straight where the way is bent.
            motion = self._motion() if self.free_datum else None
            while True:
                if self.progress is not None:
                    self.progress(min(self.iterations / self.max_iterations, 1.0), "adjustment")
                if self.iterations >= self.max_iterations:
                    raise NoConvergence(
                        f"the adjustment has not settled after {self.iterations} steps "
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
                promised = -float(equations.gradient @ step) - sum(
                    float((block.gradient * one).sum())
                    for block, one in zip(equations.blocks, local, strict=True)
                )
                trial = retract(self.state, step, local)
                new = np.inf
                if all(model.principal_distance_px > 0.0 for model in trial.models):
                    residuals = trial.residuals()
                    new = total_loss(trial, residuals, self.prior, limit)
                # NaN, a point behind a lens, is not better.
                better = new <= loss
                ending = (
                    damping <= UNDAMPED_THRESHOLD
                    and promised <= CONVERGENCE_TOLERANCE + (tolerance + ROUNDING_TOLERANCE) * loss
                )
                if better:
                    # Less than was promised: the way bends, and shorter steps follow it.
                    kept = (loss - new) / promised if promised > 0.0 else 1.0
                    damping *= 0.1 if kept > 0.75 else 1.0 if kept > 0.25 else 3.0
                    damping = max(damping, 1e-12)
                    self.state, self.residuals, loss = trial, residuals, new
                    break
                if ending:
                    break
                damping *= 10.0
                if damping > MAX_DAMPING:
                    raise NoConvergence(
                        f"the adjustment is stuck at chi2 {loss:.6g}: no step makes it smaller; "
                        "start nearer, or look for wrong readings"
                    )
            if ending:
                return


def _check_inputs(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> AdjustmentState:
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
    return AdjustmentState(tuple(models), tuple(pose_sets))


def _solve_damped(normal: Array, right: Array, motion: Array | None) -> Array:
    """Solve the damped equations, scaled to a diagonal of 1, without rigid motions (F, 6)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal), np.finfo(np.float64).tiny))
    scaled = normal * scale[:, None] * scale
    try:
        if motion is None:
            return np.asarray(scale * np.linalg.solve(scaled, scale * right), dtype=np.float64)
        basis = orthogonal_complement(motion / scale[:, None])
        inner = np.linalg.solve(basis.T @ scaled @ basis, basis.T @ (scale * right))
        return np.asarray(scale * (basis @ inner), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.zeros_like(right)


def retract(state: AdjustmentState, step: Array, local: Sequence[Array]) -> AdjustmentState:
    """Return the state after a step of the globals (F,) and the poses (B, d) of each set."""
    models = []
    first = 0
    for model in state.models:
        models.append(model.retract(step[first : first + model.parameter_count]))
        first += model.parameter_count
    pose_sets = []
    for poses, one in zip(state.pose_sets, local, strict=True):
        after = poses.retract(one)
        if poses.shape.unknowns:
            shape = poses.shape.retract(step[first : first + poses.shape.unknowns])
            after = replace(after, shape=shape)
            first += poses.shape.unknowns
        pose_sets.append(after)
    return AdjustmentState(tuple(models), tuple(pose_sets))


def _assemble_result(search: _Search, limit: float, free_datum: bool) -> AdjustmentResult:
    state, residuals = search.state, search.residuals
    weights = loss_weights(residuals, limit)
    equations = build_normal_equations(state, weights, search.prior)
    check_poses(state, equations)
    reduced = equations.reduced()
    noise_equations = None
    if any((one < 1.0).any() for one in weights):
        variances = [np.where(one < 1.0, limit**2, 1.0) for one in weights]
        noise_equations = build_normal_equations(state, variances, search.prior)
    covariance = global_covariance(
        state, reduced, search.adjusted_parameters, free_datum, noise_equations
    )
    full = [(one >= 1.0) & poses.seen for one, poses in zip(weights, state.pose_sets, strict=True)]
    chi2 = total_loss(
        state,
        [np.where(use, one, 0.0) for use, one in zip(full, residuals, strict=True)],
        search.prior,
        np.inf,
    )
    known = sum(int(use.sum()) for use in full)
    for poses in state.pose_sets:
        known += len(poses.shape.equations()[0]) + (3 * len(poses) if poses.prior() else 0)
    if search.prior is not None:
        known += int(np.linalg.matrix_rank(search.prior.information, hermitian=True))
    unknown = int(search.adjusted_parameters.sum()) - (6 if free_datum else 0)
    unknown += sum(len(poses) * poses.unknowns for poses in state.pose_sets)
    return AdjustmentResult(
        state.models,
        state.pose_sets,
        covariance,
        tuple(
            np.where(poses.seen, one, np.nan)
            for poses, one in zip(state.pose_sets, residuals, strict=True)
        ),
        tuple(weights),
        chi2,
        known - unknown,
        search.iterations,
        reduced,
    )
