"""Fresnel diffraction at a set of slits in closed form: the oracle of the coded shadow."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from compute.optics.coded_aperture.coded_window import CodedWindow

Array = NDArray[np.float64]


def code_edges_mm(window: CodedWindow) -> Array:
    """Positions where the code becomes transparent, opaque, ..., from its middle, (2 K,) [mm]."""
    changes = np.flatnonzero(np.diff(np.array((0, *window.code, 0))))
    return np.asarray(changes * window.bar_mm - window.length_mm / 2.0, dtype=np.float64)


def slit_field(position_mm: Array, edges_mm: Array, fresnel_mm: float) -> NDArray[np.complex128]:
    """Return the scalar field behind slits between edges, relative to that without a mask.

    Each edge adds ``+-(C(v) + i S(v)) / (1 + i)`` with ``v = (x - edge) sqrt(2) / fresnel_mm``;
    infinitely far apart, two edges add up to 1. (Born and Wolf, Principles of Optics, 8.7.)

    Args:
        position_mm: where the rays from the source to the observed places cross the mask,
            shape (N,) [mm].
        edges_mm: where the mask turns transparent, opaque, transparent, ..., shape (2 K,) [mm].
        fresnel_mm: ``sqrt(wavelength / W)`` with the curvature W of the optical path [mm], as
            of ``WindowPaths``; in front of a plane wave at the distance g ``sqrt(wavelength g)``.

    Returns:
        Complex field, shape (N,).
    """
    v = (position_mm[:, None] - edges_mm) * (np.sqrt(2.0) / fresnel_mm)
    sine, cosine = fresnel(v)
    sign = np.where(np.arange(len(edges_mm)) % 2 == 0, 1.0, -1.0)
    field: NDArray[np.complex128] = ((cosine + 1j * sine) @ sign) / (1.0 + 1.0j)
    return field


def slit_intensity(position_mm: Array, edges_mm: Array, fresnel_mm: float) -> Array:
    """Return the intensity of ``slit_field``, shape (N,): 1 where there is no mask."""
    field = slit_field(position_mm, edges_mm, fresnel_mm)
    return np.asarray(field.real**2 + field.imag**2)
