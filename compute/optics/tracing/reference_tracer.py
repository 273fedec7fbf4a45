"""Exact ray trace through a stack of surfaces in NumPy: refraction, apertures, losses."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.tracing.intersection import Bools, Vectors, dot, intersect, normal
from compute.optics.tracing.surface_records import Form, Records, pack
from compute.optics.tracing.surfaces import Array, SurfaceStack
from compute.parameter_checks import require_shape


class RayStatus(IntEnum):
    """Status of a traced ray."""

    ARRIVED = 0
    """It reached the plane of the sensor."""
    MISSED = 1
    """It does not meet a surface."""
    STOPPED = 2
    """It met a surface outside of its opening."""
    TOTALLY_REFLECTED = 3
    """It could not leave a denser glass."""


@dataclass(frozen=True, eq=False)
class TracedRays:
    """N rays at the plane of the sensor, in the sensor's own frame (x along the pixels).

    A ray that did not arrive has NaN everywhere, a transmittance of zero, and tells where it
    was lost.

    Args:
        position_mm: shape (N, 3) [mm]; z is zero.
        direction: unit vectors, shape (N, 3).
        path_mm: optical path from the ray's origin, shape (N,) [mm].
        transmittance: share of the power that arrives, shape (N, 2): for light polarised at the
            start in the plane of the ray and the x axis, and across it; their mean is that of
            unpolarised light.
        status: RayStatus, int32, shape (N,).
        lost_at: number of the surface where it was lost, the image counting as the last; -1 for
            a ray that arrived; int32, shape (N,).
    """

    position_mm: Array
    direction: Array
    path_mm: Array
    transmittance: Array
    status: NDArray[np.int32]
    lost_at: NDArray[np.int32]


CHUNK_RAYS: Final = 4096
"""Rays that are traced together: their numbers stay in the processor's cache."""

MIN_SQUARE: Final = 2.0**-800
"""A direction whose square is less, or more than the inverse, is scaled before it is normalised."""


def trace_rays(stack: SurfaceStack, origins_mm: Array, directions: Array) -> TracedRays:
    """Trace rays through a stack to its image plane, exactly and in three dimensions.

    Rays meet the surfaces in their order, whichever way they go; only crossings forward along
    the ray count, on the sheet of the surface that its vertex is on. Light that a surface
    reflects is lost: the transmittance has Fresnel's coefficients of both polarisations, which
    are followed through every plane of incidence (Born & Wolf, Principles of Optics, 1.5.2).
    Absorption, coatings and diffraction are left out.

    Args:
        stack: the surfaces.
        origins_mm: where the rays start, in the stack's frame, shape (N, 3) [mm].
        directions: their directions, of any length, shape (N, 3).

    Raises:
        InvalidParameter: shapes that do not fit, values not finite, directions of no length.
    """
    origins, vectors = validate_rays(origins_mm, directions)
    records = pack(stack)
    count = len(origins)
    results = empty_results(count)
    for start in range(0, count, CHUNK_RAYS):
        part = slice(start, start + CHUNK_RAYS)
        trace_chunk(records, origins[part], vectors[part], results, part)
    return results


def validate_rays(origins_mm: Array, directions: Array) -> tuple[Array, Array]:
    """Return origins and directions as float64, after checks.

    Args:
        origins_mm: start points, shape (N, 3) [mm].
        directions: of any length, shape (N, 3).

    Raises:
        InvalidParameter: arrays of another shape, values that are not finite, or a direction
            without length.
    """
    arrays = []
    for name, values in (("origins_mm", origins_mm), ("directions", directions)):
        array = np.asarray(values, dtype=np.float64)
        require_shape(array.ndim == 2 and array.shape[1] == 3, "be (N, 3)", **{name: array})
        if not np.isfinite(array).all():
            row = int((~np.isfinite(array)).any(axis=1).argmax())
            raise InvalidParameter(
                f"{name} of ray {row} is {array[row].tolist()}; it must be finite",
                **{name: array[row].tolist()},
            )
        arrays.append(array)
    origins, vectors = arrays
    if len(origins) != len(vectors):
        raise InvalidParameter(
            f"directions has {len(vectors)} rows and origins_mm {len(origins)}; they must be as "
            "many",
            directions=vectors.shape,
        )
    x, y, z = vectors.T
    zero = (x == 0.0) & (y == 0.0) & (z == 0.0)
    if zero.any():
        row = int(zero.argmax())
        raise InvalidParameter(
            f"directions of ray {row} is zero; it must have a length",
            directions=vectors[row].tolist(),
        )
    return origins, vectors


def empty_results(count: int) -> TracedRays:
    """Return results of ``count`` rays, none of which has arrived."""
    return TracedRays(
        position_mm=np.full((count, 3), np.nan),
        direction=np.full((count, 3), np.nan),
        path_mm=np.full(count, np.nan),
        transmittance=np.zeros((count, 2)),
        status=np.zeros(count, np.int32),
        lost_at=np.full(count, -1, np.int32),
    )


def trace_chunk(
    records: Records, origins: Array, directions: Array, results: TracedRays, part: slice
) -> None:
    """Trace validated rays into a part of the results.

    Args:
        records: the surfaces, SURFACE_RECORDs.
        origins: components of the start points [mm].
        directions: components of the unit vectors.
        results: of all rays, written in place.
        part: the rows of these rays.
    """
    # Lost rays go on as NaN, which costs less than to sort them out.
    with np.errstate(all="ignore"):
        origin = _columns(origins)
        direction = _normalise(_columns(directions))
        status, lost_at = results.status[part], results.lost_at[part]
        fields = _polarisations(direction)
        power, path = np.ones(len(origins)), np.zeros(len(origins))
        for number, record in enumerate(records):
            origin, local = _into_frame(record, origin, direction)
            distance, position = intersect(record, origin, local)
            _lose(np.isnan(distance), RayStatus.MISSED, number, status, lost_at)
            path = path + record["index_before"] * distance
            if number == len(records) - 1:
                break
            _lose(~_passes(record, position), RayStatus.STOPPED, number, status, lost_at)
            if record["refracts"]:
                direction, fields, power, reflected = _refract(
                    record, position, local, direction, fields, power
                )
                _lose(reflected, RayStatus.TOTALLY_REFLECTED, number, status, lost_at)
            origin = _out_of_frame(record, position)
        arrived = status == RayStatus.ARRIVED
        for axis in range(3):
            results.position_mm[part, axis] = np.where(arrived, position[axis], np.nan)
            results.direction[part, axis] = np.where(arrived, local[axis], np.nan)
        results.path_mm[part] = np.where(arrived, path, np.nan)
        for which, field in enumerate(fields):
            results.transmittance[part, which] = np.where(arrived, power * dot(field, field), 0.0)


def _lose(
    rays: Bools,
    why: RayStatus,
    number: int,
    status: NDArray[np.int32],
    lost_at: NDArray[np.int32],
) -> None:
    """Note why and where rays are lost, unless they were before."""
    rays = rays & (status == RayStatus.ARRIVED)
    status[rays] = why
    lost_at[rays] = number


def _columns(rows: Array) -> Vectors:
    x, y, z = (column.copy() for column in rows.T)
    return x, y, z


def _normalise(vectors: Vectors) -> Vectors:
    """Return unit vectors; lengths whose squares overflow or vanish are scaled first."""
    x, y, z = vectors
    square = dot(vectors, vectors)
    extreme = ~((square > MIN_SQUARE) & (square < 1.0 / MIN_SQUARE))
    if extreme.any():
        largest = np.where(extreme, np.maximum(np.maximum(abs(x), abs(y)), abs(z)), 1.0)
        x, y, z = x / largest, y / largest, z / largest
        square = x * x + y * y + z * z
    scale = 1.0 / np.sqrt(square)
    return x * scale, y * scale, z * scale


def _polarisations(d: Vectors) -> tuple[Vectors, Vectors]:
    """Return unit vectors across the rays: in the plane of ray and x axis, and across it."""
    h = np.sqrt(d[1] * d[1] + d[2] * d[2])
    # A ray along x has no such plane: any will do, and this is that of x and z.
    along = h == 0.0
    scale = 1.0 / h
    u = np.where(along, 1.0, d[2] * scale)
    v = np.where(along, 0.0, -d[1] * scale)
    zero = np.zeros(h.shape)
    return (h, v * d[0], -(u * d[0])), (zero, u, v)


def _into_frame(record: np.void, origin: Vectors, direction: Vectors) -> tuple[Vectors, Vectors]:
    vertex, r = record["vertex_mm"], record["rotation"]
    moved = (origin[0] - vertex[0], origin[1] - vertex[1], origin[2] - vertex[2])
    if not record["is_rotated"]:
        return moved, direction
    return _times(r.T, moved), _times(r.T, direction)


def _out_of_frame(record: np.void, position: Vectors) -> Vectors:
    vertex = record["vertex_mm"]
    if record["is_rotated"]:
        position = _times(record["rotation"], position)
    return position[0] + vertex[0], position[1] + vertex[1], position[2] + vertex[2]


def _times(m: Array, v: Vectors) -> Vectors:
    x, y, z = (m[i, 0] * v[0] + m[i, 1] * v[1] + m[i, 2] * v[2] for i in range(3))
    return x, y, z


def _passes(record: np.void, position: Vectors) -> Bools:
    half_width, half_height = record["half_width_mm"], record["half_height_mm"]
    if record["elliptical"]:
        u, v = position[0] / half_width, position[1] / half_height
        passes: Bools = u * u + v * v <= 1.0
    else:
        passes = (abs(position[0]) <= half_width) & (abs(position[1]) <= half_height)
    return passes


def _refract(
    record: np.void,
    position: Vectors,
    local: Vectors,
    d: Vectors,
    fields: tuple[Vectors, Vectors],
    power: Array,
) -> tuple[Vectors, tuple[Vectors, Vectors], Array, Bools]:
    """Refract rays by Snell's law; return directions, fields, power, and which are reflected.

    The field across the plane of incidence (s) is transmitted with t_s, that in it (p) with
    t_p = t_s / cos(i - t), Born & Wolf 1.5.2 (20a). Both at once: the transmitted field is t_s
    times the incident one, projected along the incident ray to be across the refracted one.
    """
    ratio = record["ratio"]
    if record["form"] == Form.PLANE:
        cosine = local[2]
        axis = record["rotation"][:, 2]
        n = axis[0], axis[1], axis[2]
    else:
        surface_normal = normal(record, position)
        cosine = dot(local, surface_normal)
        n = _times(record["rotation"], surface_normal) if record["is_rotated"] else surface_normal
    inner = abs(cosine)
    square = 1.0 - ratio * ratio * (1.0 - inner * inner)
    outer = np.sqrt(square)
    bend = np.where(cosine < 0.0, ratio * inner - outer, outer - ratio * inner)
    new = (ratio * d[0] + bend * n[0], ratio * d[1] + bend * n[1], ratio * d[2] + bend * n[2])
    # Back to unit length: rounding would else grow from surface to surface.
    scale = 1.5 - 0.5 * dot(new, new)
    out: Vectors = (new[0] * scale, new[1] * scale, new[2] * scale)
    a, b = record["index_before"] * inner, record["index_behind"] * outer
    power = power * (4.0 * a * b / ((a + b) * (a + b)))
    stretch = 1.0 / dot(d, out)
    first, second = (_project(field, d, out, stretch) for field in fields)
    return out, (first, second), power, square < 0.0


def _project(field: Vectors, d: Vectors, out: Vectors, stretch: Array) -> Vectors:
    along = dot(field, out) * stretch
    return field[0] - d[0] * along, field[1] - d[1] * along, field[2] - d[2] * along
