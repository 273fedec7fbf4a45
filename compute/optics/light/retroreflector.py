"""Passive markers: retro-reflective discs and their illuminator."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.optics.light.emission import AngularEmission
from compute.optics.light.light_source import (
    check_exposure,
    directions,
    photons,
    towards_lenses,
    unit_facing,
)
from compute.parameter_checks import check_not_negative, check_positive, require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Illuminator:
    """A lamp near the lens, small beside its distance from the markers.

    Args:
        position_mm: where it is [mm].
        direction: along the axis of its beam, any length.
        radiant_intensity_w_per_sr: on the axis, all its emitters together [W/sr].
        emission: its pattern off the axis, the beam.
        wavelength_nm: mean wavelength [nm].
        spectral_width_nm: full width at half maximum of the spectrum [nm].

    Raises:
        InvalidParameter: a value that is not positive (the spectral width may be zero), a
            direction without length.
    """

    position_mm: Vector3
    direction: Vector3
    radiant_intensity_w_per_sr: float
    emission: AngularEmission
    wavelength_nm: float
    spectral_width_nm: float = 0.0

    def __post_init__(self) -> None:
        check_positive(self, "radiant_intensity_w_per_sr", "wavelength_nm")
        check_not_negative(self, "spectral_width_nm")
        length = np.linalg.norm(self.direction)
        require(0.0 < length < np.inf, "have a length", direction=self.direction)

    def irradiance_w_per_m2(self, points_mm: Array) -> Array:
        """Return the irradiance normal to the light, shape (N,) [W/m^2].

        It falls with the square of the distance. A point in the lamp itself has none.
        """
        axis = np.array(self.direction) / np.linalg.norm(self.direction)
        towards, distance_mm = directions(np.array(self.position_mm), points_mm)
        intensity = self.radiant_intensity_w_per_sr * self.emission.relative(towards @ axis)
        squared = (distance_mm * 1e-3) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(distance_mm > 0.0, intensity / squared, 0.0)


@dataclass(frozen=True)
class RetroSheet:
    """Retro-reflective sheet: coefficient of retro-reflection and its angular fall-off.

    The coefficient of retro-reflection R_A is the intensity sent back, by the irradiance of a
    plane across the incident light and by the sheet's area: [cd/(lx m^2)], which is [1/sr] in
    radiometric units, too, at the wavelength at hand (ASTM E808, E809; CIE 54). It is given for
    light along the normal, sent straight back. From there it falls as
    ``R_A(a, b) = R_A 2^-(a/a_half)^2 cos(b) 2^-(b/b_half)^2`` with the observation angle a
    between the ways of light in and out, and the entrance angle b between the light and the
    normal; the cosine is that of the area seen by the light.

    Args:
        coefficient_per_sr: R_A at no observation and no entrance angle [1/sr].
        observation_half_angle_rad: a_half, where half is left [rad].
        entrance_half_angle_rad: b_half, where half is left beside the cosine [rad].

    Raises:
        InvalidParameter: a value that is not positive.
    """

    coefficient_per_sr: float
    observation_half_angle_rad: float
    entrance_half_angle_rad: float

    def __post_init__(self) -> None:
        check_positive(
            self, "coefficient_per_sr", "observation_half_angle_rad", "entrance_half_angle_rad"
        )

    def observation_factor(self, angle_rad: Array) -> Array:
        """Return the relative R_A at observation angles, any shape."""
        return np.asarray(np.exp2(-((angle_rad / self.observation_half_angle_rad) ** 2)))

    def entrance_factor(self, angle_rad: Array) -> Array:
        """Return the relative R_A at entrance angles, any shape; zero from behind."""
        transmitted = np.exp2(-((angle_rad / self.entrance_half_angle_rad) ** 2))
        return np.asarray(transmitted * np.cos(angle_rad).clip(0.0))


@dataclass(frozen=True)
class RetroDisc:
    """A flat disc of retro-reflective sheet.

    Args:
        diameter_mm: of the disc [mm].
        sheet: its material.
        illuminator: what lights it.

    Raises:
        InvalidParameter: a diameter that is not positive.
    """

    diameter_mm: float
    sheet: RetroSheet
    illuminator: Illuminator

    def __post_init__(self) -> None:
        check_positive(self, "diameter_mm")

    @property
    def wavelength_nm(self) -> float:
        """Mean wavelength of the illuminator [nm]."""
        return self.illuminator.wavelength_nm

    @property
    def spectral_width_nm(self) -> float:
        """Full width at half maximum of the illuminator's spectrum [nm]."""
        return self.illuminator.spectral_width_nm

    @property
    def width_mm(self) -> float:
        """The diameter [mm]."""
        return self.diameter_mm

    @property
    def face_m2(self) -> float:
        """Area of the disc [m^2]."""
        return float(np.pi / 4.0 * (self.diameter_mm * 1e-3) ** 2)

    def reflected_photons(self, points_mm: Array, towards: Array, exposure_s: float) -> Array:
        """Return photons per steradian and effective area, shape (N, S) [1/(sr m^2)].

        Args:
            points_mm: positions of N markers, shape (N, 3) [mm].
            towards: unit vectors to S lenses, shape (N, S, 3).
            exposure_s: length of the exposure [s].
        """
        check_exposure(exposure_s)
        back, _ = directions(points_mm, np.array(self.illuminator.position_mm))
        # By the chord: an arc cosine would lose angles below 1e-8, and round those near them.
        chord = np.linalg.norm(towards - back[:, None, :], axis=-1)
        observation_factor = self.sheet.observation_factor(
            2.0 * np.arcsin((0.5 * chord).clip(max=1.0))
        )
        irradiance = self.illuminator.irradiance_w_per_m2(points_mm)
        intensity = self.sheet.coefficient_per_sr * irradiance[:, None] * observation_factor
        return photons(intensity * exposure_s, self.wavelength_nm)

    def photons_per_sr(
        self, points_mm: Array, facing: Array | None, lens_positions_mm: Array, exposure_s: float
    ) -> Array:
        """Return the photons towards each lens, shape (N, S) [1/sr].

        They fall with the square of the distance to the illuminator.

        Args:
            points_mm: positions of N markers in the world, shape (N, 3) [mm].
            facing: directions in which they face, any length, shape (N, 3); None: each towards
                every lens.
            lens_positions_mm: centres of S lenses, shape (S, 3) [mm].
            exposure_s: length of the exposure [s].
        """
        towards = towards_lenses(points_mm, lens_positions_mm)
        sent = self.reflected_photons(points_mm, towards, exposure_s)
        normal = towards if facing is None else unit_facing(facing, points_mm)[:, None, :]
        back, _ = directions(points_mm, np.array(self.illuminator.position_mm))
        cosine = (normal * back[:, None, :]).sum(axis=-1)
        # Seen from behind, a disc is as dark as lit from behind.
        front = (cosine > 0.0) & ((normal * towards).sum(axis=-1) > 0.0)
        entrance_factor = self.sheet.entrance_factor(np.arccos(cosine.clip(-1.0, 1.0)))
        return np.where(front, sent * entrance_factor * self.face_m2, 0.0)
