"""Calibration beside SciPy and pyceres: ``python -m benchmarks.calibration [--json]``.

19 control points and four sensors, readings with 1 px of noise. Ours is `calibrate` as it stands:
no starting values, seven parameters, the covariance with it. The peers minimise the same
residuals over the eleven coefficients of the thesis ([5.18], [5.19]), as section 5.6 did, with
NumPy arrays of all 19 points, one sensor after the other, with analytic slopes (SciPy once without
too); they check nothing and give no covariance. Our search alone, over the seven parameters that
the eleven hold, stands beside them from the same starts.
Their starts: every coefficient 1 % wrong, and as far off as Table 5.11 is from Table 5.10.

pyceres calls its cost function back in Python, once a step for all points of a sensor: its C++
solver is not what takes its time with 19 points.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.points import rig
from compute.calibration.levenberg import minimise
from compute.calibration.run import calibrate
from compute.calibration.thesis_bundle import StepGrid, flat, generated, unflat
from compute.camera.dlt import collinearity_parameters_of, model_from_collinearity
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]
Row = dict[str, str | int | float | None]
Solver = Callable[["Bundle", Array], Array]

POINTS: Final = 19
SIGMA_PX: Final = 1.0
FRAMES: Final = 10
"""Frames of other points and noise: 40 sensors to count minima in."""
STARTS: Final = ("1 % wrong", "Table 5.11")
NEAR: Final = 0.01
REACHED: Final = 1e-6
"""A minimum is reached where the squares are above the lowest by no more than this part."""
MOST_EVALUATIONS: Final = 2000
OURS: Final = "lumiline calibrate, from nothing"
SEARCH: Final = "lumiline minimise, seven"


@dataclass(frozen=True, eq=False)
class Frame:
    """Control points (19, 3), readings (19, 4) and the true cameras."""

    points_mm: Array
    readings_px: Array
    models: tuple[SensorModel, ...]

    @property
    def sensors(self) -> list[SensorGeometry]:
        """What is known of the sensors."""
        return [SensorGeometry(model.name, model.pixels) for model in self.models]


@dataclass(frozen=True, eq=False)
class Bundle:
    """Residuals of one sensor over the eleven coefficients, in the order of ``NAMES``."""

    points_mm: Array
    readings_px: Array

    def values(self, x: Array) -> Array:
        """Return generated minus measured readings, shape (19,) [px]."""
        return np.asarray(generated(x, self.points_mm) - self.readings_px)

    def slopes(self, x: Array) -> Array:
        """Return d values / d coefficients, shape (19, 11)."""
        relative = self.points_mm - x[2:5]
        along, depth = relative @ x[5:8], relative @ x[8:11]
        q = along / depth
        gain = (-x[0] / depth)[:, None]
        jacobian = np.empty((len(relative), 11))
        jacobian[:, 0] = -q
        jacobian[:, 1] = 1.0
        jacobian[:, 2:5] = -gain * (x[5:8] - q[:, None] * x[8:11])
        jacobian[:, 5:8] = gain * relative
        jacobian[:, 8:11] = -gain * q[:, None] * relative
        return jacobian

    def squares(self, x: Array) -> float:
        """Return the sum of squares [px^2]."""
        values = self.values(x)
        return float(values @ values)


def frames() -> list[Frame]:
    """Return frames of points within 200 mm of the rig's aim, from fixed seeds."""
    made = []
    cameras = rig()
    models = _models(cameras)
    for seed in range(FRAMES):
        rng = np.random.default_rng(seed)
        points = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-200.0, 200.0, (POINTS, 3))
        exact = cameras.project(points)
        made.append(Frame(points, exact + SIGMA_PX * rng.standard_normal(exact.shape), models))
    return made


def _models(cameras: CameraStack) -> tuple[SensorModel, ...]:
    points = np.array([0.0, 0.0, 1500.0]) + 200.0 * np.random.default_rng(1).uniform(
        -1.0, 1.0, (40, 3)
    )
    sensors = [SensorGeometry(f"s{k}", 2048) for k in range(len(cameras))]
    return calibrate(points, cameras.project(points), sensors).models


def near_start(model: SensorModel, rng: np.random.Generator) -> Array:
    """Return the true coefficients, each off by 1 % (of a metre, of 1, where it is small)."""
    true = flat(collinearity_parameters_of(model))
    size = np.array([true[0], true[1], *[1000.0] * 3, *[1.0] * 6])
    return np.asarray(true + NEAR * size * rng.choice([-1.0, 1.0], 11))


def thesis_start(model: SensorModel) -> Array:
    """Return coefficients off from the true ones as Table 5.11 is from Table 5.10."""
    sensor = SensorGeometry(model.name, model.pixels)
    return StepGrid.about(collinearity_parameters_of(model), sensor).first


def by_scipy(bundle: Bundle, start: Array) -> Array:
    """Minimise by MINPACK's Levenberg-Marquardt."""
    found = least_squares(
        bundle.values, start, jac=bundle.slopes, method="lm", x_scale="jac",
        max_nfev=MOST_EVALUATIONS,
    )  # fmt: skip
    return np.asarray(found.x)


def by_scipy_numerical(bundle: Bundle, start: Array) -> Array:
    """Minimise likewise with slopes by differences, which is what one writes first."""
    found = least_squares(
        bundle.values, start, method="lm", x_scale="jac", max_nfev=12 * MOST_EVALUATIONS
    )
    return np.asarray(found.x)


def pyceres_solver() -> Solver:
    """Return a solver by pyceres.

    Raises:
        ImportError: it is not installed.
    """
    # Its annotations are not complete: to the type checker it is anything.
    pyceres: Any = import_module("pyceres")

    class Cost(pyceres.CostFunction):  # type: ignore[misc]
        """The residuals of one sensor."""

        def __init__(self, bundle: Bundle) -> None:
            pyceres.CostFunction.__init__(self)
            self.bundle = bundle
            self.set_num_residuals(len(bundle.readings_px))
            self.set_parameter_block_sizes([11])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            x = np.asarray(parameters[0])
            values = self.bundle.values(x)
            if not np.isfinite(values).all():
                return False
            residuals[:] = values
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = self.bundle.slopes(x).ravel()
            return True

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.max_num_iterations = MOST_EVALUATIONS
    options.function_tolerance = 1e-12
    options.gradient_tolerance = 1e-12
    options.parameter_tolerance = 1e-12
    options.minimizer_progress_to_stdout = False
    options.logging_type = pyceres.LoggingType.SILENT
    options.num_threads = 1

    def solve(bundle: Bundle, start: Array) -> Array:
        x = start.copy()
        problem = pyceres.Problem()
        cost = Cost(bundle)
        problem.add_residual_block(cost, None, [x])
        pyceres.solve(options, problem, pyceres.SolverSummary())
        return x

    return solve


def run(seconds: float = 0.3) -> list[Row]:
    """Measure all, in one run; the peers' times are beside ours."""
    sets = frames()
    peers: dict[str, Solver | str] = {
        "scipy least_squares, lm": by_scipy,
        "scipy, slopes by differences": by_scipy_numerical,
    }
    try:
        peers["pyceres, dense QR"] = pyceres_solver()
    except ImportError:
        peers["pyceres, dense QR"] = "not installed: pip install pyceres"
    least = [_least(frame) for frame in sets]
    first = sets[0]
    ours = _time(partial(calibrate, first.points_mm, first.readings_px, first.sensors), seconds)
    reached = sum(_reached(_ours(f), lowest) for f, lowest in zip(sets, least, strict=True))
    rows = [_row(OURS, "none", 7, ours, ours, reached)]
    for label in STARTS:
        models = [_as_models(f, _starts(f, label, k)) for k, f in enumerate(sets)]
        count = sum(
            _reached(_search(frame, start), lowest)
            for frame, start, lowest in zip(sets, models, least, strict=True)
        )
        spent = _time(partial(_search, first, models[0]), seconds)
        rows.append(_row(SEARCH, label, 7, spent, ours, count))
    for name, solver in peers.items():
        for label in STARTS:
            if isinstance(solver, str):
                rows.append(_row(name, label, 11, None, ours, None, solver))
                continue
            starts = [_starts(frame, label, k) for k, frame in enumerate(sets)]
            squares = [
                [b.squares(solver(b, x)) for b, x in zip(_bundles(frame), start, strict=True)]
                for frame, start in zip(sets, starts, strict=True)
            ]
            count = sum(_reached(s, lowest) for s, lowest in zip(squares, least, strict=True))
            spent = _time(partial(_all, solver, first, starts[0]), seconds)
            rows.append(_row(name, label, 11, spent, ours, count))
    return rows


def _as_models(frame: Frame, starts: Sequence[Array]) -> list[SensorModel]:
    """Return starts as metric cameras: what of the eleven coefficients is not gauge."""
    middle = frame.points_mm.mean(axis=0)
    return [
        model_from_collinearity(unflat(x), sensor, middle)
        for x, sensor in zip(starts, frame.sensors, strict=True)
    ]


def _search(frame: Frame, starts: Sequence[SensorModel]) -> list[float]:
    """Minimise over the seven parameters of all sensors at once; return the squares."""
    weights = np.ones(frame.readings_px.shape)
    cameras = CameraStack.of(starts)
    ended = minimise(cameras, frame.points_mm, frame.readings_px, weights)
    return [float(squares) for squares in ended.squares]


def _all(solver: Solver, frame: Frame, starts: list[Array]) -> None:
    for bundle, start in zip(_bundles(frame), starts, strict=True):
        solver(bundle, start)


def _bundles(frame: Frame) -> list[Bundle]:
    return [Bundle(frame.points_mm, frame.readings_px[:, k]) for k in range(len(frame.models))]


def _starts(frame: Frame, label: str, seed: int) -> list[Array]:
    rng = np.random.default_rng(100 + seed)
    if label == "Table 5.11":
        return [thesis_start(model) for model in frame.models]
    return [near_start(model, rng) for model in frame.models]


def _ours(frame: Frame) -> list[float]:
    found = calibrate(frame.points_mm, frame.readings_px, frame.sensors)
    return [fit.rms_px**2 * fit.points for fit in found.sensors]


def _least(frame: Frame) -> list[float]:
    """Return the least squares of each sensor: from the true coefficients, or ours if lower."""
    bundles, ours = _bundles(frame), _ours(frame)
    true = [flat(collinearity_parameters_of(model)) for model in frame.models]
    return [
        min(bundle.squares(by_scipy(bundle, x)), other)
        for bundle, x, other in zip(bundles, true, ours, strict=True)
    ]


def _reached(squares: Sequence[float], least: Sequence[float]) -> int:
    return sum(s <= lowest * (1.0 + REACHED) for s, lowest in zip(squares, least, strict=True))


def _row(
    method: str,
    start: str,
    parameters: int,
    spent: float | None,
    ours: float,
    reached: int | None,
    note: str | None = None,
) -> Row:
    return {
        "method": method,
        "start": start,
        "parameters": parameters,
        "time_ms": None if spent is None else spent * 1e3,
        "times_ours": None if spent is None else spent / ours,
        "minimum_reached": reached,
        "of": 4 * FRAMES,
        "note": note,
    }


def _time(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [s], of five at least (of one where no time is given)."""
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < (5 if seconds > 0.0 else 1) or time.perf_counter() < end:
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.calibration", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each method")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run(options.seconds)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    print(f"{POINTS} points x 4 sensors, {SIGMA_PX:g} px noise; the thesis: 2 to 4 hours")
    print(f"{'method':34} {'start':12} {'unknowns':>8} {'ms':>9} {'x ours':>8} {'minimum':>9}")
    for row in rows:
        if row["note"] is not None:
            print(f"{row['method']:34} {row['start']:12} {row['note']}")
            continue
        print(
            f"{row['method']:34} {row['start']:12} {row['parameters']:>8} {row['time_ms']:9.2f} "
            f"{row['times_ours']:8.2f} {row['minimum_reached']:>4} of {row['of']}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
