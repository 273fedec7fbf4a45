"""Benchmark of calibration against SciPy and pyceres: ``python -m benchmarks.calibration``.

19 control points and four sensors, readings with 1 px of noise, three jobs, each by all:

* the minimum, from the same start: every coefficient 1 % wrong, or as far off as Table 5.11 is from
  Table 5.10. Ours is the search that `calibrate` does from initial cameras, of all sensors at
  once: in the projective form, then over the seven metric parameters.
* the minimum from there, and the covariance of the parameters.
* all from nothing: ours is `calibrate` as it stands, which checks what it is given, searches from
  the linear solution and, where it leaves doubt, from a grid of others, and refuses frames that
  leave a camera open. The peers start from the
  linear solution ([5.5], normalised), minimise and work out the covariance; they check nothing.

The peers minimise the same residuals over the eleven coefficients of the thesis ([5.18], [5.19]),
as section 5.6 did, with NumPy arrays of all 19 points, one sensor after the other, with analytic
slopes (SciPy once without too). Four of the eleven are gauge: their covariance leaves these out.
The methods of one job take turns, and the least time of each counts: what else a machine does
only adds to it.

pyceres calls its cost function back in Python, once a step for all points of a sensor: its C++
solver is not what takes its time with 19 points.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration_peers import (
    Bundle,
    Solver,
    by_scipy,
    by_scipy_numerical,
    pyceres_solver,
    variance,
)
from benchmarks.triangulation import rig
from compute.calibration.calibrate import calibrate
from compute.calibration.single_sensor.camera_fit import minimise
from compute.calibration.single_sensor.design_matrix import equation_groups
from compute.calibration.single_sensor.projective_camera import metric_cameras, search_from
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from validation.thesis_methods.dlt import collinearity_parameters_of, model_from_collinearity
from validation.thesis_methods.eleven_parameter_bundle import (
    StepGrid,
    from_array,
    to_array,
)

Array = NDArray[np.float64]
Row = dict[str, str | int | float | None]
Method = Callable[["Frame", list[Array], list[SensorModel]], list[float]]
"""Does a job of all four sensors, from the start in the form that it takes: eleven coefficients or
metric cameras; returns the squares that it ends with."""

POINTS: Final = 19
SIGMA_PX: Final = 1.0
FRAMES: Final = 10
"""Frames of other points and noise: 40 sensors to count minima in."""
STARTS: Final = ("1 % wrong", "Table 5.11")
MINIMUM: Final = "minimum"
COVARIANCE: Final = "and covariance"
ALL: Final = "all, from nothing"
NEAR: Final = 0.01
REACHED: Final = 1e-6
"""A minimum is reached where the squares are above the lowest by no more than this part."""
OURS: Final = "lumiline, seven parameters"


@dataclass(frozen=True, eq=False)
class Frame:
    """Control points (19, 3), readings (19, 4) and the true cameras."""

    points_mm: Array
    readings_px: Array
    models: tuple[SensorModel, ...]

    @property
    def sensors(self) -> list[SensorGeometry]:
        """Known properties of the sensors."""
        return [SensorGeometry(model.name, model.pixels) for model in self.models]


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
    true = to_array(collinearity_parameters_of(model))
    size = np.array([true[0], true[1], *[1000.0] * 3, *[1.0] * 6])
    return np.asarray(true + NEAR * size * rng.choice([-1.0, 1.0], 11))


def thesis_start(model: SensorModel) -> Array:
    """Return true coefficients with the errors of Table 5.11 relative to Table 5.10."""
    sensor = SensorGeometry(model.name, model.pixels)
    return StepGrid.around(collinearity_parameters_of(model), sensor).first


def run(seconds: float = 0.3) -> list[Row]:
    """Measure all methods; ``times_ours`` is relative to our time for the same task and start."""
    sets = frames()
    solvers: dict[str, Solver | str] = {
        "scipy least_squares, lm": by_scipy,
        "scipy, slopes by differences": by_scipy_numerical,
    }
    try:
        solvers["pyceres, dense QR"] = pyceres_solver()
    except ImportError:
        solvers["pyceres, dense QR"] = "not installed: pip install pyceres"
    least = [_min_squares(frame) for frame in sets]
    rows = []
    for job, label in (
        *((MINIMUM, label) for label in STARTS),
        *((COVARIANCE, label) for label in STARTS),
        (ALL, "none"),
    ):
        starts = [_starts(frame, label, k) for k, frame in enumerate(sets)]
        methods: dict[str, Method] = {OURS: _OURS[job]}
        notes: dict[str, str] = {}
        for name, solver in solvers.items():
            if isinstance(solver, str):
                notes[name] = solver
            elif job == MINIMUM or solver is not by_scipy_numerical:
                methods[name] = partial(_by_peer, solver, job)
        models = [_as_models(*each) for each in zip(sets, starts, strict=True)]
        reached = {
            name: sum(
                _reached(method(frame, start, own), lowest)
                for frame, start, own, lowest in zip(sets, starts, models, least, strict=True)
            )
            for name, method in methods.items()
        }
        first = sets[0], starts[0], models[0]
        times = _times([partial(method, *first) for method in methods.values()], seconds)
        for name, spent in zip(methods, times, strict=True):
            rows.append(_row(job, name, label, spent, times[0], reached[name]))
        rows += [_row(job, name, label, None, times[0], None, note) for name, note in notes.items()]
    return rows


def _as_models(frame: Frame, starts: Sequence[Array]) -> list[SensorModel]:
    """Return start values as metric cameras, without the gauge freedom of the coefficients."""
    centre = frame.points_mm.mean(axis=0)
    return [
        model_from_collinearity(from_array(x), sensor, centre)
        for x, sensor in zip(starts, frame.sensors, strict=True)
    ]


def _minimum(frame: Frame, _starts: list[Array], models: list[SensorModel]) -> list[float]:
    """Minimise over the seven parameters of all sensors at once."""
    return our_minimum(frame, models, covariance=False)[0]


def _minimum_and_covariance(
    frame: Frame, _starts: list[Array], models: list[SensorModel]
) -> list[float]:
    return our_minimum(frame, models, covariance=True)[0]


def our_minimum(
    frame: Frame, models: Sequence[SensorModel], *, covariance: bool
) -> tuple[list[float], CameraStack, Array | None]:
    """Return sums of squares, cameras and optional covariances (4, 7, 7) of our adjustment."""
    weights = np.ones(frame.readings_px.shape)
    observed = frame.points_mm, frame.readings_px, weights
    centre = np.broadcast_to(frame.points_mm.mean(axis=0), (len(models), 3))
    starts = metric_cameras(search_from(*observed, models), frame.sensors, centre)
    ended = minimise(starts, frame.points_mm, frame.readings_px, weights)
    squares = [float(one) for one in ended.squares]
    if not covariance:
        return squares, ended.cameras, None
    (group,) = equation_groups(models, frame.points_mm, weights, stack=ended.cameras)
    scale = [variance(bundle, one) for bundle, one in zip(bundles(frame), squares, strict=True)]
    return squares, ended.cameras, group.cofactors * np.array(scale)[:, None, None]


def _calibrated(
    frame: Frame, _starts: Sequence[Array] = (), _models: Sequence[SensorModel] = ()
) -> list[float]:
    found = calibrate(frame.points_mm, frame.readings_px, frame.sensors)
    return [fit.rms_px**2 * fit.points for fit in found.sensors]


_OURS: Final[dict[str, Method]] = {
    MINIMUM: _minimum,
    COVARIANCE: _minimum_and_covariance,
    ALL: _calibrated,
}


def _by_peer(
    solver: Solver, job: str, frame: Frame, starts: list[Array], _models: list[SensorModel]
) -> list[float]:
    squares = []
    for bundle, sensor, start in zip(bundles(frame), frame.sensors, starts, strict=True):
        first = bundle.linear_start(sensor.name) if job == ALL else start
        squares.append(bundle.squares(solver(bundle, first, covariance=job != MINIMUM).x))
    return squares


def bundles(frame: Frame) -> list[Bundle]:
    """Return the sensors' residuals."""
    return [Bundle(frame.points_mm, frame.readings_px[:, k]) for k in range(len(frame.models))]


def _starts(frame: Frame, label: str, seed: int) -> list[Array]:
    rng = np.random.default_rng(100 + seed)
    if label == "Table 5.11":
        return [thesis_start(model) for model in frame.models]
    return [near_start(model, rng) for model in frame.models]


def _min_squares(frame: Frame) -> list[float]:
    """Return each sensor's minimal sum of squares: from the true coefficients, or ours."""
    true = [to_array(collinearity_parameters_of(model)) for model in frame.models]
    return [
        min(bundle.squares(by_scipy(bundle, x).x), other)
        for bundle, x, other in zip(bundles(frame), true, _calibrated(frame), strict=True)
    ]


def _reached(squares: Sequence[float], least: Sequence[float]) -> int:
    return sum(s <= lowest * (1.0 + REACHED) for s, lowest in zip(squares, least, strict=True))


def _row(
    job: str,
    method: str,
    start: str,
    spent: float | None,
    ours: float,
    reached: int | None,
    note: str | None = None,
) -> Row:
    return {
        "job": job,
        "method": method,
        "start": start,
        "parameters": 7 if method == OURS else 11,
        "time_ms": None if spent is None else spent * 1e3,
        "times_ours": None if spent is None else spent / ours,
        "minimum_reached": reached,
        "of": 4 * FRAMES,
        "note": note,
    }


def _times(calls: Sequence[Callable[[], object]], seconds: float) -> list[float]:
    """Return the shortest time of each call [s], of at least five repetitions."""
    times: list[list[float]] = [[] for _ in calls]
    end = time.perf_counter() + seconds * len(calls)
    while len(times[0]) < (5 if seconds > 0.0 else 1) or time.perf_counter() < end:
        for call, spent in zip(calls, times, strict=True):
            begin = time.perf_counter()
            call()
            spent.append(time.perf_counter() - begin)
    return [min(spent) for spent in times]


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
    print(f"{'job':18} {'start':11} {'method':29} {'ms':>8} {'x ours':>7} {'minimum':>9}")
    for row in rows:
        print(f"{row['job']:18} {row['start']:11} {row['method']:29} ", end="")
        if row["note"] is not None:
            print(row["note"])
            continue
        print(
            f"{row['time_ms']:8.2f} {row['times_ours']:7.2f} "
            f"{row['minimum_reached']:>3} of {row['of']}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
