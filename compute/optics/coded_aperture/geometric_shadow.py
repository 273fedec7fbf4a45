"""Geometric shadow of a coded mask, without diffraction."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.optics.coded_aperture.coded_window import CodedWindow

Array = NDArray[np.float64]

_MIN_BLUR_MM = 1e-4  # a narrower one, below the wavelength, shows nowhere


class Shadow(Protocol):
    """Mean transmission of a mask over a stretch, with a penumbra."""

    def mean_transmission(
        self, centre_mm: Array, width_mm: Array, blur_mm: Array, curvature_per_mm: Array
    ) -> Array:
        """Return the light on stretches relative to that without a mask, all of one shape.

        Args:
            centre_mm: middle of the stretch, along the readings from the middle of the code
                [mm].
            width_mm: its width, a pixel's, seen on the mask [mm].
            blur_mm: width of the penumbra, the emitter's seen on the mask [mm].
            curvature_per_mm: curvature of the optical path, as of ``WindowPaths`` [1/mm].
        """
        ...


class GeometricShadow:
    """Shadow without diffraction: exact overlaps of pixel, penumbra and bars.

    Args:
        window: the window.
    """

    def __init__(self, window: CodedWindow) -> None:
        self._bar_mm = window.bar_mm
        self._start_mm = -window.length_mm / 2.0
        # One opaque bar on each side carries the integrals on beyond the ends.
        self._code = np.array((0, *window.code, 0), dtype=np.float64)
        # In bars these are whole and half numbers, exact however long the code.
        self._once = np.concatenate([[0.0], np.cumsum(self._code)[:-1]])
        self._twice = np.concatenate([[0.0], np.cumsum(self._once + self._code / 2.0)[:-1]])

    def mean_transmission(
        self, centre_mm: Array, width_mm: Array, blur_mm: Array, curvature_per_mm: Array
    ) -> Array:
        """Return the light on stretches relative to that without a mask.

        Args:
            centre_mm: middles of the stretches, along the readings from the middle of the code
                [mm].
            width_mm: their widths, of the same shape [mm].
            blur_mm: widths of the penumbra, of the same shape [mm].
            curvature_per_mm: curvatures of the optical paths [1/mm]; without effect here.
        """
        del curvature_per_mm
        centre = self._bar(centre_mm)

        def integral(position_mm: Array) -> Array:
            """Return the second integral without its linear part, which cancels."""
            bar = self._bar(position_mm)
            rest = (position_mm - self._start_mm) / self._bar_mm + 1.0 - bar
            bars = bar - centre
            once, twice = self._once[bar], self._twice[bar]
            constant = twice - self._twice[centre] - self._once[centre] * bars
            slope = once - self._once[centre]
            return np.asarray(
                (constant + (slope + self._code[bar] * rest / 2.0) * rest) * self._bar_mm**2
            )

        return second_difference(integral, centre_mm, width_mm, blur_mm)

    def _bar(self, position_mm: Array) -> NDArray[np.int64]:
        """Return the number of the bar at a position, the frame's counting as one on each side."""
        bar = np.floor((position_mm - self._start_mm) / self._bar_mm) + 1.0
        return np.clip(bar, 0, len(self._code) - 1).astype(np.int64)


def second_difference(
    integral: Callable[[Array], Array], centre_mm: Array, width_mm: Array, blur_mm: Array
) -> Array:
    """Average a function over a stretch and a penumbra, from its second integral.

    Args:
        integral: the second integral of the function [mm^2].
        centre_mm: middles of the stretches [mm].
        width_mm: widths of the stretches [mm].
        blur_mm: widths of the penumbra [mm].
    """
    blur = np.maximum(blur_mm, _MIN_BLUR_MM)
    far, near = (width_mm + blur) / 2.0, (width_mm - blur) / 2.0
    outer = integral(centre_mm + far) + integral(centre_mm - far)
    inner = integral(centre_mm + near) + integral(centre_mm - near)
    return (outer - inner) / (width_mm * blur)
