"""Measured volumes with holes, fields to be mapped, and cameras: none of the mapping's own code."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel

Array = NDArray[np.float64]
Layout = Literal["random", "jittered", "2:1", "4:1", "slices", "scan lines", "10 % lost"]
Shape = Literal["none", "sphere", "ellipsoid", "slab", "wedge", "L", "channel", "corner"]

LAYOUTS: Final[tuple[Layout, ...]] = (
    "random", "jittered", "2:1", "4:1", "slices", "scan lines", "10 % lost",
)  # fmt: skip
SHAPES: Final[tuple[Shape, ...]] = (
    "sphere", "ellipsoid", "slab", "wedge", "L", "channel", "corner",
)  # fmt: skip
CENTRE_MM: Final = np.array([0.0, 0.0, 1700.0])
HALF_MM: Final = np.array([400.0, 350.0, 300.0])
SENSORS: Final = 4
PIXELS: Final = 8192
PRINCIPAL_PX: Final = 4000.0


def cameras() -> tuple[SensorModel, ...]:
    """Return four cameras on a bar, at different angles about the axis of view."""
    found = []
    for k in range(SENSORS):
        turn = Rotation.from_rotvec([0.0, 0.0, k * np.pi / SENSORS])
        x, y, z = turn.as_rotvec().tolist()
        offset = -turn.apply([200.0 * (k - 1.5), 0.0, 0.0])
        found.append(
            SensorModel(f"s{k + 1}", PIXELS, PRINCIPAL_PX, 4095.5, (x, y, z), float(offset[0]), 0.0)
        )
    return tuple(found)


def read(points_mm: Array) -> Array:
    """Return what the cameras read of points (N, 3) without any distortion, shape (N, S) [px]."""
    angle = np.arange(SENSORS) * np.pi / SENSORS
    shift = points_mm[:, 0, None] - 200.0 * (np.arange(SENSORS) - 1.5)
    across = np.cos(angle) * shift - np.sin(angle) * points_mm[:, 1, None]
    return np.asarray(4095.5 + PRINCIPAL_PX * across / points_mm[:, 2, None])


@dataclass(frozen=True, eq=False)
class Hole:
    """A region without measurements.

    Args:
        shape: its kind.
        centre: in units of the box's half edges, shape (3,).
        half: half edges or semi-axes in the same units, shape (3,).
        axis: along which a slab is thin, a wedge is sharp or a channel runs.
    """

    shape: Shape
    centre: Array
    half: Array
    axis: int = 0

    def contains(self, unit: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3), in units of the box's half edges, lie in it, shape (N,)."""
        if self.shape == "none":
            return np.zeros(len(unit), dtype=np.bool_)
        scaled = (unit - self.centre) / self.half
        one, two = (self.axis + 1) % 3, (self.axis + 2) % 3
        inside: NDArray[np.bool_]
        if self.shape in ("sphere", "ellipsoid"):
            inside = np.asarray((scaled**2).sum(axis=1) < 1.0)
        elif self.shape == "slab":
            inside = np.asarray(np.abs(scaled[:, self.axis]) < 1.0)
        elif self.shape == "wedge":
            thin = np.abs(scaled[:, one]) < 0.5 * (1.0 - scaled[:, self.axis])
            inside = thin & (np.abs(scaled) < 1.0).all(axis=1)
        elif self.shape == "L":
            arm = np.abs(scaled) < 1.0
            quarter = (scaled[:, one] > 0.0) & (scaled[:, two] > 0.0)
            inside = arm.all(axis=1) & ~quarter
        elif self.shape == "channel":
            inside = np.asarray(scaled[:, one] ** 2 + scaled[:, two] ** 2 < 1.0)
        else:
            inside = np.asarray((np.abs(scaled) < 1.0).all(axis=1))
        return inside


def random_hole(shape: Shape, size: float, rng: np.random.Generator) -> Hole:
    """Draw a hole.

    Args:
        shape: its kind.
        size: its width relative to the box, 0 to 1.
        rng: draws its position and proportions.
    """
    if shape == "none":
        return Hole(shape, np.zeros(3), np.ones(3))
    axis = int(rng.integers(3))
    half = np.full(3, size)
    if shape == "sphere":
        half = size * HALF_MM.min() / HALF_MM
    elif shape == "ellipsoid":
        half = size * rng.uniform(0.7, 1.0, 3)
    elif shape == "slab":
        half = np.full(3, 0.6 * size)
    elif shape == "channel":
        half = np.full(3, 0.8 * size)
    free = np.maximum(0.9 - half, 0.0)
    centre = free * rng.uniform(-0.7, 0.7, 3)
    if shape == "corner":
        centre = np.sign(rng.uniform(-1.0, 1.0, 3)) * (1.0 - half) * 1.001
    return Hole(shape, centre, half, axis)


def places(layout: Layout, count: int, rng: np.random.Generator) -> Array:
    """Return about ``count`` measured places in units of the box's half edges, shape (N, 3)."""
    side = HALF_MM / np.cbrt(HALF_MM.prod())
    if layout == "random":
        return rng.uniform(-1.0, 1.0, (count, 3))
    if layout in ("2:1", "4:1"):
        ratio = 2.0 if layout == "2:1" else 4.0
        dense = rng.uniform(size=count) < ratio / (1.0 + ratio)
        found = rng.uniform(-1.0, 1.0, (count, 3))
        found[:, 0] = np.where(dense, 1.0, -1.0) * np.abs(found[:, 0])
        return found
    if layout in ("jittered", "10 % lost"):
        numbers = np.rint(np.cbrt(count) * side).astype(int)
        jitter = 0.5
    elif layout == "slices":
        numbers = np.rint(np.cbrt(count / 4.0) * side * [2.0, 2.0, 1.0]).astype(int)
        jitter = 0.3
    else:
        numbers = np.rint(np.cbrt(count / 4.0) * side * [4.0, 1.0, 1.0]).astype(int)
        jitter = 0.3
    axes = [(np.arange(number) + 0.5) / number * 2.0 - 1.0 for number in numbers]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = lattice + jitter * rng.uniform(-1.0, 1.0, lattice.shape) / numbers
    # To the surface of the box.
    found /= np.abs(found).max(axis=0)
    if layout == "10 % lost":
        found = found[rng.uniform(size=len(found)) > 0.1]
    return np.asarray(found)


@dataclass(frozen=True, eq=False)
class Field:
    """A correction field of one sensor: a smooth part and a feature.

    Args:
        wave: directions and phases of the smooth part's waves, shape (W, 4).
        amplitude_px: of the waves, shape (W,).
        centre: of the feature, in units of the box's half edges, shape (3,).
        width_mm: its full width at half maximum along the axes, shape (3,).
        feature_px: its height.
    """

    wave: Array
    amplitude_px: Array
    centre: Array
    width_mm: Array
    feature_px: float

    def at(self, unit: Array) -> Array:
        """Return the correction at points (N, 3), in units of the half edges, shape (N,) [px]."""
        smooth = np.sin(unit @ self.wave[:, :3].T + self.wave[:, 3]) @ self.amplitude_px
        off = (unit - self.centre) * HALF_MM / self.width_mm
        return np.asarray(smooth + self.feature_px * np.exp2(-4.0 * (off**2).sum(axis=1)))


def random_field(
    centre: Array, width_mm: Array, feature_px: float, rng: np.random.Generator
) -> Field:
    """Draw a smooth field of three waves that are longer than the box, with a feature.

    Args:
        centre: of the feature, in units of the box's half edges, shape (3,).
        width_mm: its full width at half maximum along the axes, shape (3,).
        feature_px: its height.
        rng: draws the smooth part.
    """
    direction = rng.standard_normal((3, 3))
    direction *= rng.uniform(1.0, 2.5, 3)[:, None] / np.linalg.norm(direction, axis=1)[:, None]
    wave = np.column_stack([direction, rng.uniform(0.0, 2.0 * np.pi, 3)])
    return Field(wave, rng.uniform(0.2, 0.8, 3), centre, width_mm, feature_px)
