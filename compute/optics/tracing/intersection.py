"""Intersections of rays with a surface in its own frame, and the surface's normals.

The kernel does the same operations in the same order, so that both give the same numbers.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.tracing.surface_records import BACKWARD_SLACK_MM, Form
from compute.optics.tracing.surfaces import Array

Vectors = tuple[Array, Array, Array]
"""Components of N vectors, each of shape (N,)."""

Bools = NDArray[np.bool_]
Height = Callable[[NDArray[np.int64], Array], tuple[Array, Array, Array]]

MAX_INTERVALS: Final = 400
"""Intervals looked at for the crossing with a toroid; some ten suffice but for grazing rays."""
MIN_INTERVAL_FRACTION: Final = 2.0**-40
"""Interval, of the smaller radius, that is not divided further: a ray that grazes the surface."""
MAX_STEPS: Final = 100
"""Steps of Newton's method; some five suffice, and bisection alone needs sixty."""
CONVERGENCE_FRACTION: Final = 2.0**-32
"""Last step of Newton's method, of the smaller radius; the next would be of its square."""
ROUNDING: Final = 2.0**-50
"""Relative resolution of distances."""


def dot(a: Vectors, b: Vectors) -> Array:
    """Return the scalar products of vectors given by components.

    Args:
        a: components x, y, z, arrays of any shape.
        b: likewise.
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def intersect(record: np.void, origin: Vectors, direction: Vectors) -> tuple[Array, Vectors]:
    """Return where rays first meet a surface going forward, on the sheet of its vertex.

    Args:
        record: the surface, a SURFACE_RECORD.
        origin: start points [mm], in the surface's own frame.
        direction: unit vectors.

    Returns:
        Distance along each ray [mm], NaN where it does not meet the surface, and intersection.
    """
    x, y, z = origin
    dx, dy, dz = direction
    if record["form"] == Form.PLANE:
        t = -z / dz
        met = (t >= -BACKWARD_SLACK_MM) & (t < np.inf)
        t = np.where(met, t, np.nan)
        return t, (x + t * dx, y + t * dy, np.where(met, 0.0, np.nan))
    # To the ray's nearest point to the vertex: the squares below then lose no digits, however far
    # away the ray starts.
    shift = -dot(origin, direction)
    near = (x + shift * dx, y + shift * dy, z + shift * dz)
    find = _quadric if record["form"] == Form.QUADRIC else _toroid
    t = find(record, near, direction, -BACKWARD_SLACK_MM - shift)
    return shift + t, (near[0] + t * dx, near[1] + t * dy, near[2] + t * dz)


def normal(record: np.void, position: Vectors) -> Vectors:
    """Return the unit normals of a curved surface, towards +z at the vertex.

    Args:
        record: the surface, a SURFACE_RECORD.
        position: points on it, in the surface's own frame [mm].
    """
    x, y, z = position
    cx, cy, e = record["cx"], record["cy"], record["e"]
    if record["form"] == Form.QUADRIC:
        n = (-(cx * x), -(cy * y), 1.0 - e * z)
    else:
        s, g = _rotate(cy, y, z)
        depth = (1.0 - e * g) / s
        n = (-(cx * x), -(depth * (cy * y)), depth * (1.0 - cy * z))
    scale = 1.0 / np.sqrt(dot(n, n))
    return n[0] * scale, n[1] * scale, n[2] * scale


def _quadric(record: np.void, origin: Vectors, direction: Vectors, t_min: Array) -> Array:
    """Solve a t^2 + 2 b t + g = 0; NaN where no root is forward and on the sheet."""
    x, y, z = origin
    dx, dy, dz = direction
    cx, cy, e = record["cx"], record["cy"], record["e"]
    a = cx * dx * dx + cy * dy * dy + e * dz * dz
    b = cx * x * dx + cy * y * dy + (e * z - 1.0) * dz
    g = cx * x * x + cy * y * y + (e * z - 2.0) * z
    root = np.sqrt(b * b - a * g)
    # b and the root are added, never subtracted: no cancellation, however flat the surface.
    q = np.where(b < 0.0, root - b, -(root + b))
    one, two = g / q, q / a
    first, second = np.where(one < two, one, two), np.where(one < two, two, one)

    def valid(t: Array) -> Bools:
        # The sheet of the vertex is where 1 - (1 + k) c z >= 0.
        on_sheet: Bools = 1.0 - e * (z + t * dz) >= 0.0
        return (t >= t_min) & (t < np.inf) & on_sheet

    return np.where(valid(first), first, np.where(valid(second), second, np.nan))


def _rotate(cy: float, y: Array, z: Array) -> tuple[Array, Array]:
    """Return the distance from a toroid's axis in units of Ry, and its distance g from Ry [mm]."""
    p, q = 1.0 - cy * z, cy * y
    s = np.sqrt(p * p + q * q)
    return s, (2.0 * z - cy * (z * z + y * y)) / (1.0 + s)


def _height(
    record: np.void, origin: Vectors, direction: Vectors, t: Array
) -> tuple[Array, Array, Array]:
    """Return, at t, the height h over a toroid, and the slopes of its two parts.

    ``h = g - f``: g is how far the ray is from the circle of the vertex, towards the axis, and
    f is the profile's sag at the ray's x. Along a ray g is concave where Ry > 0, and f is convex
    where Rx > 0, so that their slopes at the ends of an interval bound them inside of it.
    """
    cx, cy, e = record["cx"], record["cy"], record["e"]
    x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
    s, g = _rotate(cy, y, z)
    g_slope = ((1.0 - cy * z) * direction[2] - cy * y * direction[1]) / s
    square = 1.0 - e * cx * x * x
    w = np.sqrt(np.where(square > 0.0, square, 0.0))
    f = cx * x * x / (1.0 + w)
    return g - f, g_slope, cx * x * direction[0] / w


def _toroid(record: np.void, origin: Vectors, direction: Vectors, t_min: Array) -> Array:
    """Find the first root by intervals on which the height is shown to be monotonic."""
    result = np.full(t_min.shape, np.nan)
    low, high = _domain(record, origin, direction, t_min)
    rays = np.flatnonzero(low < high)
    low, high = low[rays], high[rays]
    width = high - low
    min_interval = record["radius_mm"] * MIN_INTERVAL_FRACTION
    max_last_step = record["radius_mm"] * CONVERGENCE_FRACTION

    def at(which: NDArray[np.int64], t: Array) -> tuple[Array, Array, Array]:
        o = tuple(c[which] for c in origin)
        d = tuple(c[which] for c in direction)
        return _height(record, o, d, t)  # type: ignore[arg-type]

    h, gs, fs = at(rays, low)
    for _ in range(MAX_INTERVALS):
        if not len(rays):
            break
        right = np.where(low + width < high, low + width, high)
        h2, gs2, fs2 = at(rays, right)
        steepest = _larger(gs, gs2) - _smaller(fs, fs2)
        flattest = _smaller(gs, gs2) - _larger(fs, fs2)
        monotonic = (flattest >= 0.0) | (steepest <= 0.0)
        crosses = (h <= 0.0) != (h2 <= 0.0)
        fine = width <= min_interval + ROUNDING * abs(low)
        bracketed = crosses & (monotonic | fine)
        if bracketed.any():
            result[rays[bracketed]] = _newton(
                at, rays[bracketed], low[bracketed], right[bracketed], h[bracketed], max_last_step
            )
        # Lines from both ends bound h: if they meet on the side of the ends, there is no root.
        span = right - low
        top = h + steepest * ((h2 - h - flattest * span) / (steepest - flattest))
        bottom = h + flattest * ((h2 - h - steepest * span) / (flattest - steepest))
        below, above = (h <= 0.0) & (top < 0.0), (h > 0.0) & (bottom > 0.0)
        clear = ~crosses & (monotonic | fine | below | above)
        keep = ~bracketed & ~(clear & (right >= high))
        low = np.where(clear, right, low)[keep]
        h, gs, fs = (
            np.where(clear, new, old)[keep] for new, old in ((h2, h), (gs2, gs), (fs2, fs))
        )
        width = np.where(clear, 2.0 * width, 0.5 * width)[keep]
        rays, high = rays[keep], high[keep]
    return result


def _newton(
    at: Height, rays: NDArray[np.int64], low: Array, high: Array, h_low: Array, max_last_step: float
) -> Array:
    """Find the root between low and high, where the height has opposite signs.

    Newton's method; a step that would leave the bracket halves it instead.
    """
    result = np.empty(low.shape)
    index = np.arange(len(low))
    low_negative = h_low <= 0.0
    t = 0.5 * (low + high)
    for step in range(MAX_STEPS):
        h, g_slope, f_slope = at(rays, t)
        same_side = (h <= 0.0) == low_negative
        low, high = np.where(same_side, t, low), np.where(same_side, high, t)
        newton = t - h / (g_slope - f_slope)
        inside = (newton >= low) & (newton <= high)
        new = np.where(inside, newton, 0.5 * (low + high))
        moved = np.where(inside, abs(new - t), high - low)
        converged = (moved <= max_last_step + ROUNDING * abs(new)) | (step == MAX_STEPS - 1)
        result[index[converged]] = new[converged]
        go = ~converged
        if not go.any():
            break
        index, rays, low_negative = index[go], rays[go], low_negative[go]
        t, low, high = new[go], low[go], high[go]
    return result


def _domain(
    record: np.void, origin: Vectors, direction: Vectors, t_min: Array
) -> tuple[Array, Array]:
    """Return where along its ray a toroid can be: forward, within its reach, before its axis."""
    x, _, z = origin
    dx, _, dz = direction
    cy, reach, profile = record["cy"], record["reach_mm"], record["profile_reach_mm"]
    low = np.where(t_min > -reach, t_min, -reach)
    high = np.full(t_min.shape, reach)
    if profile < np.inf:
        one, two = (-profile - x) / dx, (profile - x) / dx
        low = _larger(low, _smaller(one, two))
        high = _smaller(high, _larger(one, two))
    # 1 - cy z >= 0: the side of the axis on which the vertex is.
    at, slope = 1.0 - cy * z, cy * dz
    end = at / slope
    high = np.where(slope > 0.0, _smaller(high, end), high)
    low = np.where(slope < 0.0, _larger(low, end), low)
    return low, np.where((slope == 0.0) & (at < 0.0), np.nan, high)


def _larger(a: Array, b: Array) -> Array:
    return np.where(a > b, a, b)


def _smaller(a: Array, b: Array) -> Array:
    return np.where(a < b, a, b)
