"""Guide rays of a fan: a few aimed rays, and Chebyshev series from which all others start."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial.chebyshev import chebval, chebvander
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.optics.tracing.assembly import Assembly, Lens
from compute.optics.tracing.reference_tracer import TracedRays
from compute.optics.tracing.surfaces import sag

Array = NDArray[np.float64]


GUIDES: Final = 9  # aimed rays that all others start from

_FEW_TERMS: Final = 4  # of a guide where rays are lost

NODES: Final = np.cos(np.pi * (np.arange(GUIDES) + 0.5) / GUIDES)

_HIT_MM: Final = 1e-4  # a ray that passes its height on the row by more was not aimed

_STEEPEST: Final = 1.0  # largest tangent of slanting light along x

_CORNERS: Final = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])


def hits_row(rays: TracedRays, aim: "RayTargets") -> NDArray[np.bool_]:
    """Return whether rays meet the row at their heights, shape (R,).

    Args:
        rays: R traced rays, in the sensor's frame.
        aim: the R rays as they were aimed.
    """
    return np.asarray(np.abs(rays.position_mm[:, 1] - aim.height_mm) <= _HIT_MM)


def pupil_reach_mm(assembly: Assembly) -> float:
    """Return the half width of the light-admitting part of the first plane along x [mm].

    A rotated opening reaches farther than half its width, and one that lies before or behind the
    plane, being tilted or the edge of a curved face, is passed by slanting light elsewhere in it.
    """
    first = assembly.elements[0]
    heights = [element.aperture.height_mm for element in assembly.elements]
    finite = [height for height in heights if np.isfinite(height)]
    half = 0.5 * np.array([first.aperture.width_mm, min(heights[0], max(finite, default=100.0))])
    x, y = (signs.ravel() * size for signs, size in zip(_CORNERS, half, strict=True))
    depth = np.zeros_like(x)
    if isinstance(first, Lens):
        # Only the corners of a round lens may lie beyond where its face ends.
        depth = np.nan_to_num(sag(first.shapes[0], x, y))
    corners = Rotation.from_rotvec(first.alignment.tilt_rad).apply(np.stack([x, y, depth], axis=1))
    return float((np.abs(corners[:, 0]) + _STEEPEST * np.abs(corners[:, 2])).max())


@dataclass(frozen=True, eq=False)
class RayTargets:
    """R rays to aim: start points (R, 3), heights on the row and x in the pupil (R,)."""

    source_mm: Array
    height_mm: Array
    pupil_mm: Array

    @classmethod
    def of(cls, source_mm: Array, height_mm: Array, pupil_mm: Array) -> "RayTargets":
        """Return the rays of fans.

        Args:
            source_mm: start points, shape (R, 3) [mm].
            height_mm: heights on the row, shape (R,) [mm].
            pupil_mm: x in the pupil, shape (R, M) [mm].
        """
        samples = pupil_mm.shape[1]
        return cls(
            np.repeat(source_mm, samples, axis=0), np.repeat(height_mm, samples), pupil_mm.ravel()
        )

    def part(self, which: NDArray[np.bool_]) -> "RayTargets":
        """Return some of the rays."""
        return RayTargets(self.source_mm[which], self.height_mm[which], self.pupil_mm[which])


@dataclass(frozen=True, eq=False)
class GuideSeries:
    """Chebyshev series of aimed rays: y in the pupil, and its derivative, over x.

    Args:
        centre_mm: centre of the pupil [mm].
        reach_mm: half its width [mm].
        y_mm: coefficients, shape (K, N, 1).
        slope: coefficients, shape (K, N, 1).
        unreliable: fans of which rays are lost or not aimed, so that the series is not to be relied
            on, shape (N,).
    """

    centre_mm: float
    reach_mm: float
    y_mm: Array
    slope: Array
    unreliable: NDArray[np.bool_]

    def at(self, pupil_mm: Array) -> tuple[Array, Array]:
        """Return y and its derivative at positions (N, M) in the pupil, both (N, M)."""
        x = (pupil_mm - self.centre_mm) / self.reach_mm
        return (
            np.asarray(chebval(x, self.y_mm, tensor=False), dtype=np.float64),
            np.asarray(chebval(x, self.slope, tensor=False), dtype=np.float64),
        )


def fit_series(values: Array, usable: NDArray[np.bool_], otherwise: float) -> Array:
    """Return Chebyshev coefficients (K, N, 1) of values at the nodes.

    Where rays are lost the series is a low one, fitted to those that are found.

    Args:
        values: at the nodes, shape (N, K).
        usable: which of them are known, same shape.
        otherwise: constant where none is.
    """
    basis = chebvander(NODES, GUIDES - 1)
    series = np.linalg.solve(basis, np.where(usable, values, 0.0).T)
    for row in np.flatnonzero(~usable.all(axis=1)):
        series[:, row] = 0.0
        usable_row = usable[row]
        terms = min(_FEW_TERMS, int(usable_row.sum()))
        if terms == 0:
            series[0, row] = otherwise
            continue
        fitted, *_ = np.linalg.lstsq(basis[usable_row, :terms], values[row, usable_row], rcond=None)
        series[:terms, row] = fitted
    return np.asarray(series[:, :, None], dtype=np.float64)
