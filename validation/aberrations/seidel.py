"""Seidel aberration coefficients: analytic sums, and fits to traced rays.

The coefficients are those of the thesis's [3.8]-[3.20] (Born & Wolf, section 5.3): with the
paraxial image of the object point at the height y0 and a ray through the exit pupil at
``xi = rho sin(theta)``, ``eta = rho cos(theta)``, the ray misses the paraxial image by

    dx = B rho^3 sin - F y0 rho^2 sin 2theta + D y0^2 rho sin
    dy = B rho^3 cos - F y0 rho^2 (1 + 2 cos^2) + (2 C + D) y0^2 rho cos - E y0^3

([3.14] prints a sine in the first term of dy; the derivative of [3.13] has the cosine). B is
spherical aberration, F coma, C astigmatism, D curvature of field, E distortion, positive for a
barrel. Lengths are in mm, so each of them is in 1/mm^2.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, NoConvergence
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from compute.optics.tracing.surfaces import Conic, Cylinder, Plane, SurfaceStack
from validation.aberrations.paraxial import ParaxialSystem, paraxial_system

Array = NDArray[np.float64]

_OBJECTS: Final = 5  # heights in the object plane, evenly spaced on both sides of the axis
_RADII: Final = 3
_ANGLES: Final = 8


@dataclass(frozen=True)
class Conjugates:
    """Positions of the object and the stop of a system.

    Args:
        object_mm: place of the object plane on the axis [mm], before the first surface.
        stop: number of the surface that is the stop.
    """

    object_mm: float
    stop: int


@dataclass(frozen=True)
class SeidelCoefficients:
    """Five Seidel coefficients of [3.8], each [1/mm^2]."""

    spherical_b: float
    astigmatism_c: float
    field_curvature_d: float
    distortion_e: float
    coma_f: float


@dataclass(frozen=True)
class MeridionalCoefficients:
    """Coefficients that a cylindrical system has along its power axis, each [1/mm^2].

    ``dx = B rho^3 - 3 F x0 rho^2 + (2 C + D) x0^2 rho - E x0^3`` for rays in the plane of the
    power axis, where a cylinder is what a sphere is; C and D have no meaning of their own there.
    """

    spherical_b: float
    tangential_curvature_2c_d: float
    distortion_e: float
    coma_f: float


@dataclass(frozen=True, eq=False)
class AberrationFit:
    """Coefficients fitted to traced rays.

    Args:
        coefficients: the fit.
        residual_rms_mm: what the third order leaves of the rays' aberrations, RMS [mm].
        aberration_rms_mm: the aberrations themselves, RMS [mm].
    """

    coefficients: SeidelCoefficients | MeridionalCoefficients
    residual_rms_mm: float
    aberration_rms_mm: float


def seidel_sums(system: ParaxialSystem, conjugates: Conjugates) -> SeidelCoefficients:
    """Return the coefficients by Seidel sums over the surfaces, from two paraxial rays.

    S_I = -sum A^2 y d(u/n), S_II = -sum A A' y d(u/n), S_III = -sum A'^2 y d(u/n),
    S_IV = -sum H^2 c d(1/n), S_V = -sum A' [A'^2 y d(1/n^2) - (H + A' y) y' c d(1/n)] with
    A = n (y c + u) of the marginal ray, A' and y' of the chief ray, H Lagrange's invariant, and
    figuring k c^3 (n' - n) (W. T. Welford, Aberrations of Optical Systems, 1986, chapter 8).

    Args:
        system: the paraxial system.
        conjugates: object and stop.

    Raises:
        InvalidParameter: an object that has no image, a stop that is not there.
    """
    pupil, magnification, scale = _pupils(system, conjugates)
    depth = system.vertex_mm[0] - conjugates.object_mm
    to_pupil = pupil - conjugates.object_mm
    # The marginal ray passes the entrance pupil at 1 mm, the chief ray begins at 1 mm.
    y, u = system.trace(depth / to_pupil, 1.0 / to_pupil)
    y_chief, u_chief = system.trace(1.0 - depth / to_pupil, -1.0 / to_pupil)
    n, c = system.index, system.curvature_per_mm
    a, a_chief = n[:-1] * (y * c + u[:-1]), n[:-1] * (y_chief * c + u_chief[:-1])
    invariant = n[0] * (u_chief[0] * y[0] - u[0] * y_chief[0])
    step = np.diff(u / n)
    power = c * np.diff(1.0 / n)
    figure = system.conic * c**3 * np.diff(n)
    s1 = -(a**2 * y * step) + figure * y**4
    s2 = -(a * a_chief * y * step) + figure * y**3 * y_chief
    s3 = -(a_chief**2 * y * step) + figure * y**2 * y_chief**2
    s4 = -(invariant**2 * power)
    s5 = -a_chief * (
        a_chief**2 * y * np.diff(1.0 / n**2) - (invariant + a_chief * y) * y_chief * power
    )
    s5 += figure * y * y_chief**3
    one, two, three, four, five = (
        float(part.sum() / (2.0 * n[-1] * u[-1])) for part in (s1, s2, s3, s4, s5)
    )
    # From 1 mm in the entrance pupil and on the object to mm in the exit pupil and the image.
    return SeidelCoefficients(
        spherical_b=one / scale**3,
        astigmatism_c=three / (scale * magnification**2),
        field_curvature_d=(three + four) / (scale * magnification**2),
        distortion_e=-five / magnification**3,
        coma_f=-two / (scale**2 * magnification),
    )


def fit_seidel(
    stack: SurfaceStack, conjugates: Conjugates, pupil_radius_mm: float, object_height_mm: float
) -> AberrationFit:
    """Fit the coefficients to the ray aberrations of a spherical system, by least squares.

    What is left is of the fifth order: halving both arguments divides it by 32, and the error of
    the coefficients by 4.

    Args:
        stack: centred planes and conics of revolution; openings are not heeded.
        conjugates: object and stop.
        pupil_radius_mm: largest radius of the rays in the entrance pupil [mm].
        object_height_mm: largest height in the object plane [mm].

    Raises:
        InvalidParameter: a surface that is not one of revolution; see ``seidel_sums``.
        NoConvergence: rays that do not get through.
    """
    _check_shapes(stack, (Plane, Conic))
    radius = pupil_radius_mm * (np.arange(_RADII) + 1.0) / _RADII
    theta = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    height = object_height_mm * np.linspace(-1.0, 1.0, _OBJECTS)
    h, r, angle = (g.ravel() for g in np.meshgrid(height, radius, theta, indexing="ij"))
    pupil = np.stack([r * np.sin(angle), r * np.cos(angle)], axis=1)
    heights = np.stack([np.zeros_like(h), h], axis=1)
    miss, image, exit_pupil = _ray_aberrations(stack, conjugates, heights, pupil)
    (xi, eta), y0, square = exit_pupil.T, image[:, 1], (exit_pupil**2).sum(axis=1)
    zero = np.zeros_like(xi)
    along_x = [square * xi, zero, y0**2 * xi, zero, -2.0 * y0 * xi * eta]
    along_y = [
        square * eta, 2.0 * y0**2 * eta, y0**2 * eta, -(y0**3), -y0 * (square + 2.0 * eta**2)
    ]  # fmt: skip
    design = np.concatenate([np.stack(along_x, axis=1), np.stack(along_y, axis=1)])
    values, rest = _least_squares(design, miss.T.ravel())
    return AberrationFit(SeidelCoefficients(*values), _rms(rest), _rms(miss))


def fit_meridional(
    stack: SurfaceStack, conjugates: Conjugates, pupil_radius_mm: float, object_height_mm: float
) -> AberrationFit:
    """Fit the coefficients of a cylindrical (or any) system to rays in the plane of its power.

    Args:
        stack: centred planes, cylinders and conics; openings are not heeded.
        conjugates: object and stop.
        pupil_radius_mm: largest distance of the rays from the middle of the entrance pupil [mm].
        object_height_mm: largest height in the object plane, along x [mm].

    Raises:
        InvalidParameter, NoConvergence: as of ``fit_seidel``.
    """
    _check_shapes(stack, (Plane, Conic, Cylinder))
    height = object_height_mm * np.linspace(-1.0, 1.0, _OBJECTS)
    radius = pupil_radius_mm * np.linspace(-1.0, 1.0, 2 * _RADII + 1)
    h, r = (g.ravel() for g in np.meshgrid(height, radius, indexing="ij"))
    zero = np.zeros_like(h)
    miss, image, exit_pupil = _ray_aberrations(
        stack, conjugates, np.stack([h, zero], axis=1), np.stack([r, zero], axis=1)
    )
    rho, x0 = exit_pupil[:, 0], image[:, 0]
    design = np.stack([rho**3, x0**2 * rho, -(x0**3), -3.0 * x0 * rho**2], axis=1)
    values, rest = _least_squares(design, miss[:, 0])
    return AberrationFit(MeridionalCoefficients(*values), _rms(rest), _rms(miss[:, 0]))


def meridional(coefficients: SeidelCoefficients) -> MeridionalCoefficients:
    """Return the coefficients of a cylinder with the profile of a spherical system."""
    return MeridionalCoefficients(
        coefficients.spherical_b,
        2.0 * coefficients.astigmatism_c + coefficients.field_curvature_d,
        coefficients.distortion_e,
        coefficients.coma_f,
    )


def _pupils(system: ParaxialSystem, conjugates: Conjugates) -> tuple[float, float, float]:
    """Return the entrance pupil's place [mm], lateral and pupil magnification."""
    if not conjugates.object_mm < system.vertex_mm[0]:
        raise InvalidParameter(
            f"object_mm is {conjugates.object_mm}; it must be before the first surface, at "
            f"{system.vertex_mm[0]} mm",
            object_mm=conjugates.object_mm,
        )
    pupil = system.entrance_pupil_mm(conjugates.stop)
    _, magnification = system.image_of(conjugates.object_mm)
    # At the first vertex, of rays that pass the entrance pupil's middle and 1 mm beside it.
    height, angle = system.trace(system.vertex_mm[0] - pupil, 1.0)
    if angle[-1] == 0.0:
        raise InvalidParameter(
            f"stop is {conjugates.stop}, in the front focus of what follows it: the exit pupil is "
            "at infinity; choose another",
            stop=conjugates.stop,
        )
    exit_mm = -height[-1] / angle[-1]
    parallel_height, parallel_angle = system.trace(1.0, 0.0)
    scale = parallel_height[-1] + parallel_angle[-1] * exit_mm
    return pupil, magnification, float(scale)


def _ray_aberrations(
    stack: SurfaceStack, conjugates: Conjugates, heights_mm: Array, pupil_mm: Array
) -> tuple[Array, Array, Array]:
    """Return misses of the paraxial image, the image, and places in the exit pupil, (N, 2) [mm].

    Args:
        stack: the surfaces.
        conjugates: object and stop.
        heights_mm: places in the object plane, shape (N, 2).
        pupil_mm: places in the entrance pupil, shape (N, 2).
    """
    system = paraxial_system(stack)
    entrance, magnification, scale = _pupils(system, conjugates)
    image_mm, _ = system.image_of(conjugates.object_mm)
    origins = np.column_stack([heights_mm, np.full(len(heights_mm), conjugates.object_mm)])
    through = np.column_stack([pupil_mm, np.full(len(pupil_mm), entrance)])
    towards = (through - origins) * np.sign(entrance - conjugates.object_mm)
    unbounded = tuple(replace(surface, aperture=None) for surface in stack.surfaces)
    rays = trace_rays(replace(stack, surfaces=unbounded), origins, towards)
    if (rays.status != RayStatus.ARRIVED).any():
        raise NoConvergence(
            f"{int((rays.status != RayStatus.ARRIVED).sum())} of {len(rays.status)} rays do not "
            "get through; take a smaller pupil radius or object height"
        )
    # The paraxial image may lie before or behind the sensor, or be virtual.
    slope = rays.direction[:, :2] / rays.direction[:, 2:]
    position = rays.position_mm[:, :2] + slope * (image_mm - system.image_mm)
    image = magnification * heights_mm
    return position - image, image, scale * pupil_mm


def _check_shapes(stack: SurfaceStack, allowed: tuple[type, ...]) -> None:
    for number, surface in enumerate(stack.surfaces):
        if not isinstance(surface.shape, allowed):
            names = ", ".join(shape.__name__ for shape in allowed)
            raise InvalidParameter(
                f"shape of surface {number} is {surface.shape}; it must be one of {names}",
                shape=surface.shape,
            )


def _least_squares(design: Array, values: Array) -> tuple[list[float], Array]:
    """Return the solution and the residuals, solved with columns of length 1."""
    scale = np.linalg.norm(design, axis=0)
    found = np.linalg.lstsq(design / scale, values, rcond=None)[0]
    return (found / scale).tolist(), values - design / scale @ found


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
