"""Random rigs with a residual field, measured in a part of the volume: none of the mapping's code.

Readings, fields, distances to the measured hull and normalised errors are worked out here from the
positions alone; ``SensorModel`` only carries the rig's numbers to what is judged.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, cKDTree
from scipy.spatial.transform import Rotation

from compute.camera.model import SensorModel

Array = NDArray[np.float64]
Kind = Literal["lens", "polynomial", "waves", "features", "none"]
Region = Literal["box", "ellipsoid", "hole"]

KINDS: Final[tuple[Kind, ...]] = ("lens", "polynomial", "waves", "features", "none")
REGIONS: Final[tuple[Region, ...]] = ("box", "ellipsoid", "hole")
PIXELS: Final = 8001
PRINCIPAL_PX: Final = 4000.0
COUNT: Final = (120, 300)
SIGMA_PX: Final = (0.02, 0.2)
REACH_MM: Final = 200.0
PROBES: Final = 3000
_SURFACE: Final = 20_000


@dataclass(frozen=True, eq=False)
class Rig:
    """Sensors about a volume.

    Args:
        principal_distance_px: of all sensors.
        rotation: rows are the sensors' axes in the world, shape (S, 3, 3).
        position_mm: of the sensors' lenses, shape (S, 3).
        centre_mm: of the volume, shape (3,).
        half_mm: its half edges, shape (3,).
    """

    principal_distance_px: float
    rotation: Array
    position_mm: Array
    centre_mm: Array
    half_mm: Array

    @property
    def models(self) -> tuple[SensorModel, ...]:
        """The sensors as their calibration has them, without any distortion."""
        found = []
        for number, rotation in enumerate(self.rotation):
            x, y, z = Rotation.from_matrix(rotation).as_rotvec().tolist()
            offset = -rotation @ self.position_mm[number]
            found.append(
                SensorModel(
                    f"s{number + 1}",
                    PIXELS,
                    self.principal_distance_px,
                    PRINCIPAL_PX,
                    (x, y, z),
                    float(offset[0]),
                    float(offset[2]),
                )
            )
        return tuple(found)

    def field_angles(self, points_mm: Array) -> tuple[Array, Array]:
        """Return tangents along and across each sensor's pixels, both of shape (N, S)."""
        local = np.einsum("sij,nsj->nsi", self.rotation, points_mm[:, None] - self.position_mm)
        return local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]


def random_rig(rng: np.random.Generator) -> Rig:
    """Draw four to six sensors, at different angles, that look at the middle of the volume."""
    count = int(rng.integers(4, 7))
    half = rng.uniform([250.0, 250.0, 150.0], [600.0, 600.0, 400.0])
    centre = np.array([0.0, 0.0, rng.uniform(1500.0, 2200.0)])
    base = rng.uniform(300.0, 700.0)
    angle = np.arange(count) * np.pi / count + rng.uniform(-0.1, 0.1, count)
    position = np.column_stack(
        [
            np.linspace(-base, base, count),
            rng.uniform(-100.0, 100.0, count),
            rng.uniform(-30.0, 30.0, count),
        ]
    )
    view = centre - position
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    across = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    across -= (across * view).sum(axis=1, keepdims=True) * view
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rotation = np.stack([across, np.cross(view, across), view], axis=1)
    return Rig(float(rng.uniform(1500.0, 4000.0)), rotation, position, centre, half)


@dataclass(frozen=True, eq=False)
class Field:
    """What the sensors' models lack.

    Args:
        kind: "lens": terms in both field angles that the cameras have not; "polynomial": of degree
            2 to 4 in space; "waves": longer than the box; "features": Gaussian ones in the volume
            and around it, at least a third of it wide; "none".
        rig: the sensors.
        size: coefficients, shape (S, W).
        shape: exponents (W, 3) of "polynomial", wave vectors and phases (S, W, 4) of "waves",
            centres and widths [mm] (S, W, 4) of "features".
    """

    kind: Kind
    rig: Rig
    size: Array
    shape: Array

    def at(self, points_mm: Array) -> Array:
        """Return the field at points (N, 3), shape (N, S) [px]."""
        unit = (points_mm - self.rig.centre_mm) / self.rig.half_mm
        terms: Array
        if self.kind == "lens":
            u, v = self.rig.field_angles(points_mm)
            terms = np.stack([u**3, u * v**2, u**2 * v, u**5, u**3 * v**2], axis=2)
            terms *= self.rig.principal_distance_px
        elif self.kind == "polynomial":
            terms = (unit[:, None, None] ** self.shape).prod(axis=3)
        elif self.kind == "waves":
            phase = np.einsum("na,swa->nsw", unit, self.shape[..., :3]) + self.shape[..., 3]
            terms = np.sin(phase)
        elif self.kind == "features":
            away = points_mm[:, None, None] - self.shape[..., :3]
            terms = np.exp2(-4.0 * (away**2).sum(axis=3) / self.shape[..., 3] ** 2)
        else:
            terms = np.zeros((len(points_mm), *self.size.shape))
        total: Array = (terms * self.size).sum(axis=2)
        return total


def random_field(kind: Kind, rig: Rig, rng: np.random.Generator) -> Field:
    """Draw a field of a kind: tenths of a pixel to several pixels in the volume."""
    count = len(rig.position_mm)
    height = float(np.exp(rng.uniform(np.log(0.2), np.log(3.0))))
    if kind == "lens":
        size = rng.standard_normal((count, 5)) * [0.15, 0.3, 0.03, 0.3, 0.3]
        return Field(kind, rig, size, np.empty(0))
    if kind == "polynomial":
        every = np.indices((5, 5, 5)).reshape(3, -1).T
        total = every.sum(axis=1)
        exponents = every[(total >= 2) & (total <= 4)].astype(np.float64)
        size = 2.0 * height * rng.standard_normal((count, len(exponents)))
        return Field(kind, rig, size / np.sqrt(len(exponents)), exponents)
    if kind == "waves":
        direction = rng.standard_normal((count, 3, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        direction *= rng.uniform(0.8, 2.5, (count, 3, 1))
        phase = rng.uniform(0.0, 2.0 * np.pi, (count, 3, 1))
        waves = np.concatenate([direction, phase], axis=2)
        return Field(kind, rig, height * rng.uniform(0.3, 1.0, (count, 3)), waves)
    if kind == "features":
        centre = rig.centre_mm + rig.half_mm * rng.uniform(-1.3, 1.3, (count, 3, 3))
        width = 2.0 * rig.half_mm.mean() * rng.uniform(0.6, 1.5, (count, 3, 1))
        size = height * rng.choice([-1.0, 1.0], (count, 3)) * rng.uniform(0.4, 1.0, (count, 3))
        return Field(kind, rig, size, np.concatenate([centre, width], axis=2))
    return Field(kind, rig, np.zeros((count, 1)), np.empty(0))


@dataclass(frozen=True, eq=False)
class Scene:
    """A rig, its measurements for a table, and readings of other points.

    Args:
        kind: of the field.
        region: where there are measurements.
        rig: the sensors.
        sigma_px: standard deviation of all readings [px].
        points_mm: the N measured positions, shape (N, 3).
        readings_px: of them, shape (N, S).
        probes_mm: the M other points, shape (M, 3).
        probe_readings_px: of them, shape (M, S).
        distance_mm: of the probes from the hull of the measurements, shape (M,); negative inside.
    """

    kind: Kind
    region: Region
    rig: Rig
    sigma_px: float
    points_mm: Array
    readings_px: Array
    probes_mm: Array
    probe_readings_px: Array
    distance_mm: Array


def random_scene(kind: Kind, region: Region, rng: np.random.Generator) -> Scene:
    """Draw a scene with a field of a kind, measured in a region."""
    rig = random_rig(rng)
    field = random_field(kind, rig, rng)
    sigma = float(np.exp(rng.uniform(*np.log(SIGMA_PX))))
    count = int(np.exp(rng.uniform(*np.log(COUNT))))
    unit = rng.uniform(-1.0, 1.0, (6 * count, 3))
    if region == "ellipsoid":
        unit = unit[(unit**2).sum(axis=1) < 1.0]
    elif region == "hole":
        centre, radius = rng.uniform(-0.4, 0.4, 3), rng.uniform(0.45, 0.7)
        unit = unit[((unit - centre) ** 2).sum(axis=1) > radius**2]
    points = rig.centre_mm + rig.half_mm * unit[:count]
    wide = rig.half_mm + REACH_MM
    probes = rig.centre_mm + wide * rng.uniform(-1.0, 1.0, (PROBES, 3))

    def read(positions_mm: Array) -> Array:
        u, _ = rig.field_angles(positions_mm)
        noise = sigma * rng.standard_normal(u.shape)
        return PRINCIPAL_PX + rig.principal_distance_px * u - field.at(positions_mm) + noise

    return Scene(
        kind,
        region,
        rig,
        sigma,
        points,
        read(points),
        probes,
        read(probes),
        _hull_distance(points, probes, rng),
    )


def _hull_distance(points_mm: Array, positions_mm: Array, rng: np.random.Generator) -> Array:
    """Return distances from the hull's surface, by random places on it; negative inside."""
    corners = points_mm[ConvexHull(points_mm).simplices]
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    chosen = rng.choice(len(area), _SURFACE, p=area / area.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), _SURFACE)
    surface = np.einsum("nc,nca->na", weights, corners[chosen])
    distance = np.asarray(cKDTree(surface).query(positions_mm)[0])
    inside = Delaunay(points_mm).find_simplex(positions_mm) >= 0
    return np.where(inside, -distance, distance)


def normalised_errors(error_mm: Array, covariance_mm2: Array) -> Array:
    """Return e' C^-1 e of errors (N, 3) with covariances (N, 3, 3), shape (N,)."""
    scale = np.sqrt(np.einsum("nii->ni", covariance_mm2))
    correlation = covariance_mm2 / (scale[:, :, None] * scale[:, None])
    values, vectors = np.linalg.eigh(correlation)
    along = np.einsum("nia,ni->na", vectors, error_mm / scale)
    total: Array = (along**2 / values).sum(axis=1)
    return total
