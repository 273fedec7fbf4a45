"""Simulated control points with mislabelled readings, seen by random devices."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.repair import LabelFinding
from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor
from validation.thesis_data import load_test

Array = NDArray[np.float64]

SENSORS: Final = 4
PIXELS: Final = 2048
PITCH_UM: Final = 12.0
SIGMA_PX: Final = 1.0
MIN_SIGMAS: Final = 10.0
MAX_SIGMAS: Final = 300.0

WIDE_PIXELS: Final = 5000
WIDE_PITCH_UM: Final = 7.0
WIDE_BAR_MM: Final = 600.0
WIDE_CENTRE_MM: Final = (0.0, 0.0, 1700.0)
WIDE_HALF_MM: Final = (600.0, 600.0, 200.0)
WIDE_SIGMA_PX: Final = (0.02, 1.0)

Frame = Literal["thesis", "random"]
Errors = Literal["none", "exchanged", "outlier", "points"]


@dataclass(frozen=True, eq=False)
class LabelFrame:
    """One frame: control points, readings with noise and errors, and which errors those are.

    Args:
        points_mm: shape (N, 3).
        readings_px: shape (N, 4).
        sensors: the four sensors.
        errors: kind, sensor (None: all) and points, counted from 1.
        sigma_px: standard deviation of the noise.
    """

    points_mm: Array
    readings_px: Array
    sensors: tuple[SensorGeometry, ...]
    errors: frozenset[tuple[str, str | None, tuple[int, ...]]]
    sigma_px: float = SIGMA_PX

    def found_exactly(self, findings: tuple[LabelFinding, ...]) -> bool:
        """Return whether the findings are these errors, no fewer and no more."""
        return self.errors == {(f.kind, f.sensor, f.points) for f in findings}


def random_frames(
    rng: np.random.Generator,
    count: int,
    frame: Frame,
    errors: Errors,
    number: int = 0,
    min_only: bool = False,
) -> Iterator[LabelFrame]:
    """Yield frames with ``number`` errors each.

    In half of the frames all errors are in one sensor, in the others each in any. Exchanged
    readings lie ten standard deviations apart or more; outliers are off by ten to 300, evenly
    in the logarithm, or all by ten.

    Args:
        rng: draws everything.
        count: frames wanted.
        frame: "thesis": the 19 points of its frame (Appendix G). "random": 19 to 40 points.
        errors: none; exchanged pairs of a sensor; outliers; points with each other's labels.
        number: of errors.
        min_only: whether outliers are off by ten standard deviations, no more.
    """
    made = 0
    while made < count:
        points = _thesis_points() if frame == "thesis" else _random_points(rng)
        models = _device(rng, points)
        exact = CameraStack.of(models).project(points)
        if not ((exact > 30.0) & (exact < PIXELS - 31.0)).all():
            continue
        readings = exact + SIGMA_PX * rng.standard_normal(exact.shape)
        put = _put(rng, readings, errors, number, MIN_SIGMAS if min_only else MAX_SIGMAS)
        if put is None:
            continue
        made += 1
        sensors = tuple(SensorGeometry(model.name, model.pixels) for model in models)
        yield LabelFrame(points, readings, sensors, put)


def wide_frames(
    rng: np.random.Generator, count: int, points: int, errors: Errors, number: int = 0
) -> Iterator[LabelFrame]:
    """Yield frames that fill the field of lenses with distortion, with ``number`` errors each.

    Four sensors on a bar of 600 mm look at points within 600 x 600 x 200 mm to each side, 1.7 m
    away. Each lens has a distortion of the third and, in half of the frames, of the fifth order:
    up to 0.25 and 0.3 of the tangent's power, tens to a hundred pixels at the field's edge. The
    noise is 0.02 to 1 px, evenly in the logarithm. Points outside a sensor's row are not seen.

    Args:
        rng: draws everything.
        count: frames wanted.
        points: control points.
        errors, number: see ``random_frames``.
    """
    made = 0
    while made < count:
        placed = np.array(WIDE_CENTRE_MM) + rng.uniform(-1.0, 1.0, (points, 3)) * WIDE_HALF_MM
        models = _wide_device(rng)
        sigma = float(np.exp(rng.uniform(*np.log(WIDE_SIGMA_PX))))
        readings = CameraStack.of(models).project(placed)
        readings = readings + sigma * rng.standard_normal(readings.shape)
        readings[(readings < 0.0) | (readings > WIDE_PIXELS - 1.0)] = np.nan
        put = _put(rng, readings, errors, number, MAX_SIGMAS, sigma, WIDE_PIXELS)
        if put is None:
            continue
        made += 1
        sensors = tuple(SensorGeometry(one.name, one.pixels, WIDE_PITCH_UM) for one in models)
        yield LabelFrame(placed, readings, sensors, put, sigma)


def _put(
    rng: np.random.Generator,
    readings: Array,
    errors: Errors,
    number: int,
    most: float,
    sigma: float = SIGMA_PX,
    pixels: int = PIXELS,
) -> frozenset[tuple[str, str | None, tuple[int, ...]]] | None:
    """Put errors into the readings; None where this frame has no room for them."""
    made: set[tuple[str, str | None, tuple[int, ...]]] = set()
    common = int(rng.integers(SENSORS)) if rng.random() < 0.5 else None
    used: set[tuple[int, int]] = set()
    for _ in range(number if errors != "none" else 0):
        column = int(rng.integers(SENSORS)) if common is None else common
        seen = np.isfinite(readings[:, column])
        free = [k for k in range(len(readings)) if seen[k] and (k, column) not in used]
        if errors == "outlier":
            point = int(rng.choice(free))
            size = np.exp(rng.uniform(np.log(MIN_SIGMAS), np.log(most))) * sigma
            moved = readings[point, column] + size * rng.choice([-1.0, 1.0])
            if not 0.0 <= moved <= pixels - 1.0:
                return None
            readings[point, column] = moved
            used.add((point, column))
            made.add(("outlier", f"s{column + 1}", (point + 1,)))
            continue
        first, second = sorted(map(int, rng.choice(free, 2, replace=False)))
        columns = list(range(SENSORS)) if errors == "points" else [column]
        apart = np.abs(readings[first, columns] - readings[second, columns])
        if not apart.min() >= MIN_SIGMAS * sigma:
            return None
        readings[np.ix_([first, second], columns)] = readings[np.ix_([second, first], columns)]
        for one in columns if errors == "exchanged" else range(SENSORS):
            used.update({(first, one), (second, one)})
        name = None if errors == "points" else f"s{column + 1}"
        made.add(("exchanged", name, (first + 1, second + 1)))
    return frozenset(made)


def _thesis_points() -> Array:
    points = load_test("5.4").points_mm
    return np.asarray(points - points.mean(axis=0))


def _random_points(rng: np.random.Generator) -> Array:
    extent = rng.uniform(150.0, 600.0, 3)
    return np.asarray(extent * rng.uniform(-1.0, 1.0, (int(rng.integers(19, 41)), 3)))


def _device(rng: np.random.Generator, points_mm: Array) -> tuple[SensorModel, ...]:
    """Return four sensors on a bar that look at the points, each line turned at random."""
    reach = float(np.linalg.norm(points_mm, axis=1).max())
    distance = rng.uniform(2.0, 6.0) * reach
    # The farthest point off the axis lands at 50 to 95 % of the half line.
    share = rng.uniform(0.5, 0.95)
    principal_distance = share * PIXELS / 2.0 * (distance - reach) / reach
    away = rng.standard_normal(3)
    away /= np.linalg.norm(away)
    bar = np.cross(away, rng.standard_normal(3))
    bar /= np.linalg.norm(bar)
    models = []
    for index, along in enumerate(np.linspace(-0.15, 0.15, SENSORS)):
        position = distance * (away + along * bar)
        aim = 0.05 * reach * rng.standard_normal(3)
        view = aim - position
        turned = np.cross(view, rng.standard_normal(3))
        px, py, pz = position.tolist()
        ax, ay, az = aim.tolist()
        dx, dy, dz = (turned / np.linalg.norm(turned)).tolist()
        models.append(
            place_sensor(
                f"s{index + 1}",
                lens_position_mm=(px, py, pz),
                aim_mm=(ax, ay, az),
                measured_direction=(dx, dy, dz),
                principal_distance_mm=principal_distance * PITCH_UM * 1e-3,
                pixels=PIXELS,
                pitch_um=PITCH_UM,
            ).model
        )
    return tuple(models)


def _wide_device(rng: np.random.Generator) -> tuple[SensorModel, ...]:
    """Return four sensors on a bar, rows turned by turns, their lenses' distortions at random."""
    fifth = rng.random() < 0.5
    models = []
    for index, along in enumerate(np.linspace(-0.5, 0.5, SENSORS)):
        turn = np.pi * (0.25 * index + rng.uniform(-0.05, 0.05))
        ax, ay, az = (np.array(WIDE_CENTRE_MM) + rng.uniform(-50.0, 50.0, 3)).tolist()
        distance_px = rng.uniform(2000.0, 3000.0)
        model = place_sensor(
            f"s{index + 1}",
            lens_position_mm=(float(WIDE_BAR_MM * along), 0.0, 0.0),
            aim_mm=(ax, ay, az),
            measured_direction=(float(np.cos(turn)), float(np.sin(turn)), 0.0),
            principal_distance_mm=distance_px * WIDE_PITCH_UM * 1e-3,
            pixels=WIDE_PIXELS,
            pitch_um=WIDE_PITCH_UM,
        ).model
        terms = ((1, 2), (3, 0), *(((1, 4), (3, 2), (5, 0)) if fifth else ()))
        sizes = [0.25 if i + j == 3 else 0.3 for i, j in terms]
        lens = FieldDistortion(
            terms,
            tuple((np.array(sizes) * rng.uniform(-1.0, 1.0, len(terms))).tolist()),
            offset_y_mm=_offset_y_mm(model, index),
            row_behind_mm=distance_px * WIDE_PITCH_UM * 1e-3,
        )
        models.append(replace(model, distortion=lens))
    return tuple(models)


def _offset_y_mm(model: SensorModel, index: int) -> float:
    """Return y of the world's origin in the frame of the sensor at its place on the bar."""
    along = float(np.linspace(-0.5, 0.5, SENSORS)[index])
    return -float((model.rotation @ np.array([WIDE_BAR_MM * along, 0.0, 0.0]))[1])
