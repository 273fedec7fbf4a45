"""Bad control points and readings of random rigs, by kind, each with what must be said of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from validation.random_rigs.rigs import Rig, random_rig

Array = NDArray[np.float64]

POINTS: Final = (16, 60)
NOISE_PX: Final = (0.05, 0.5)


@dataclass(frozen=True)
class Kind:
    """A kind of bad input.

    Args:
        label: what is wrong.
        refused: whether it must be refused; otherwise calibrated with a remark.
        expected: one of these texts must be in the error or the remarks.
        make: a rig and a generator to control points (N, 3) and readings (N, S).
        honest: whether an honest covariance is right, too.
    """

    label: str
    refused: bool
    expected: tuple[str, ...]
    make: Callable[[Rig, np.random.Generator], tuple[Array, Array]]
    honest: bool = False


def sound_rig(rng: np.random.Generator) -> Rig:
    """Return a rig of three sensors or more without distortion."""
    return random_rig(rng, distorted=False)


def _read(rig: Rig, points: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the points that all sensors see, and their readings with noise."""
    readings = rig.read(points)
    noise = float(np.exp(rng.uniform(*np.log(NOISE_PX))))
    readings = np.clip(readings + rng.normal(0.0, noise, readings.shape), 0.0, rig.pixels - 1.0)
    rows = np.isfinite(readings).all(axis=1)
    return points[rows], readings[rows]


def _sound(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    return _read(rig, rig.points(rng, int(rng.integers(*POINTS)), 0.8), rng)


def _sensors(rig: Rig, index: list[int]) -> Rig:
    return replace(
        rig,
        axes=rig.axes[index],
        lenses_mm=rig.lenses_mm[index],
        distance_px=rig.distance_px[index],
        centre_px=rig.centre_px[index],
        coefficients=rig.coefficients[index],
    )


def _two_sensors(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    return _sound(_sensors(rig, [0, 1]), rng)


def _copied(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    readings[:, 1] = readings[:, 0]
    return points, readings


def _copied_and_rounded(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    readings[:, 1] = np.round(readings[:, 0], 2)
    return points, readings


def _two_alike_of_three(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    return _sound(_sensors(rig, [0, 1, 0]), rng)


def _parallel_slits(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    slit = rng.normal(size=3)
    slit[2] = 0.0
    slit /= np.linalg.norm(slit)
    forward = rig.axes[:, 2] - np.outer(rig.axes[:, 2] @ slit, slit)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    axes = np.stack([np.cross(slit, forward), np.broadcast_to(slit, forward.shape), forward], 1)
    return _sound(replace(rig, axes=axes), rng)


def _unrelated(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    readings[:, 0] = rng.uniform(0.0, rig.pixels - 1.0, len(points))
    return points, readings


def _shuffled(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    return points, rng.permutation(readings)


def _zeros(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    count = int(rng.integers(2, max(3, len(points) // 4)))
    readings[rng.choice(len(points), count, replace=False), 0] = 0.0
    return points, readings


def _dead(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    readings[:, 0] = float(rng.integers(0, rig.pixels))
    return points, readings


def _metres(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    return points / 1000.0, readings


def _seven_points(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    points, readings = _sound(rig, rng)
    return points[:7], readings[:7]


def _twisted_cubic(rig: Rig, rng: np.random.Generator) -> tuple[Array, Array]:
    t = np.linspace(-1.0, 1.0, int(rng.integers(*POINTS)))
    curve = np.column_stack([t, t**2 - 1.0 / 3.0, t**3]) / [1.0, 2.0 / 3.0, 1.0]
    turned = curve @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    return _read(rig, rig.volume_centre_mm + 0.45 * rig.side_mm * turned, rng)


KINDS: Final = (
    Kind("two sensors", False, ("cannot locate a marker",), _two_sensors),
    Kind("one column copied", True, ("copy of the other",), _copied),
    Kind("one column copied and rounded", True, ("copy of the other",), _copied_and_rounded),
    Kind("two sensors alike of three", False, ("count as one",), _two_alike_of_three),
    Kind(
        "parallel slits",
        False,
        ("slits of all sensors are parallel",),
        _parallel_slits,
    ),
    Kind("random readings of a sensor", True, ("have nothing to do with the points",), _unrelated),
    Kind("rows in another order", True, ("have nothing to do with the points",), _shuffled),
    Kind("0 for not seen", True, ("leave the cell empty", "leave the cells empty"), _zeros),
    Kind("always the same reading", True, ("cannot all be there",), _dead),
    Kind("coordinates in metres", False, ("may be in metres",), _metres),
    # Seven points often leave no camera or several: refused, with their number.
    Kind(
        "seven points",
        False,
        ("leave no redundancy", "with its 7 readings", "with these 7 control points"),
        _seven_points,
    ),
    # Not every such curve is critical to a sensor.
    Kind(
        "points on a twisted cubic",
        False,
        ("near-critical", "many cameras fit", "did not converge"),
        _twisted_cubic,
        honest=True,
    ),
)
