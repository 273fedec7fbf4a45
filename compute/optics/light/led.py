"""Light-emitting diode as an active marker."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.optics.light.emission import AngularEmission
from compute.optics.light.light_source import (
    check_exposure,
    photons,
    towards_lenses,
    unit_facing,
)
from compute.parameter_checks import check_not_negative, check_positive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Led:
    """Light-emitting diode that is lit during an exposure, wholly or by a pulse.

    Section 4.3 of the thesis says how narrow its emission makes its use, section 4.4 that
    pulses of a higher current raise the signal.

    Args:
        radiant_intensity_w_per_sr: on the axis, at the nominal current [W/sr].
        wavelength_nm: mean wavelength [nm].
        emission: its pattern off the axis.
        spectral_width_nm: full width at half maximum of the spectrum [nm].
        emitter_width_mm: width of the part that shines [mm].
        current_ratio: current by the nominal one; the intensity is taken to follow it.
        pulse_s: length of the pulse within the exposure [s]; None: lit throughout. A pulse
            longer than the exposure is cut off.

    Raises:
        InvalidParameter: a value that is not positive (the spectral width, the emitter's width
            and the current may be zero).
    """

    radiant_intensity_w_per_sr: float
    wavelength_nm: float
    emission: AngularEmission
    spectral_width_nm: float = 0.0
    emitter_width_mm: float = 0.0
    current_ratio: float = 1.0
    pulse_s: float | None = None

    def __post_init__(self) -> None:
        check_positive(self, "radiant_intensity_w_per_sr", "wavelength_nm")
        check_not_negative(self, "spectral_width_nm", "emitter_width_mm", "current_ratio")
        if self.pulse_s is not None:
            check_positive(self, "pulse_s")

    @property
    def width_mm(self) -> float:
        """Width of the emitter [mm]."""
        return self.emitter_width_mm

    def photons_per_sr(
        self, points_mm: Array, facing: Array | None, lens_positions_mm: Array, exposure_s: float
    ) -> Array:
        """Return the photons towards each lens, shape (N, S) [1/sr].

        Args:
            points_mm: positions of N markers in the world, shape (N, 3) [mm].
            facing: directions in which they face, any length, shape (N, 3); None: each towards
                every lens.
            lens_positions_mm: centres of S lenses, shape (S, 3) [mm].
            exposure_s: length of the exposure [s].
        """
        check_exposure(exposure_s)
        lit_s = exposure_s if self.pulse_s is None else min(self.pulse_s, exposure_s)
        energy = self.radiant_intensity_w_per_sr * self.current_ratio * lit_s
        towards = towards_lenses(points_mm, lens_positions_mm)
        if facing is None:
            relative = np.ones(towards.shape[:2])
        else:
            cosine = np.einsum("nsk,nk->ns", towards, unit_facing(facing, points_mm))
            relative = self.emission.relative(cosine)
        return photons(energy * relative, self.wavelength_nm)
