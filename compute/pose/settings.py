"""Settings of pose fits and tool trackers; the defaults are for live use."""

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Final

from compute.camera.model import Vector3
from compute.errors import InvalidParameter

POSE_PARAMETERS: Final = 6


class _PositiveSettings:
    """Base of settings whose numbers must be positive."""

    _MAY_BE_ZERO: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, int | float):
                continue
            if name in self._MAY_BE_ZERO:
                if value < 0:
                    raise InvalidParameter(f"{name} is {value}; it must be 0 or more")
            elif not 0.0 < value < inf:
                raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})


@dataclass(frozen=True)
class PoseFitSettings(_PositiveSettings):
    """Acceptance limits of a pose fit.

    Args:
        min_redundancy: number of readings beyond six. Without redundancy the fit is exact and
            cannot be checked.
        false_rejection_probability: probability that correct readings are rejected.
        max_excluded: largest number of wrong readings that are excluded.
        min_redundancy_after_exclusion: number of readings beyond six that must remain where one
            was excluded: with fewer some four of a handful fit any tool by chance.
        max_detectable_sigma: largest minimal detectable bias of a reading, in its standard
            deviations: where a larger error of a reading would pass unnoticed, the pose is
            LOW_RELIABILITY. Four markers in full view of three sensors are below 15; 7 to 9
            readings mostly are not. None: no limit.
        ambiguity_chi2_margin: two solutions fit equally well when their chi2 differ by less: at 16
            the worse one is 3,000 times less likely.
        max_sigma_fraction: largest standard deviation of any motion, in mm at the tool's own
            radius, as a fraction of that radius. Above it the linear covariance is meaningless: at
            0.1 the second-order term of a rotation is a twentieth of the rotation.
    """

    min_redundancy: int = 1
    false_rejection_probability: float = 1e-4
    max_excluded: int = 1
    min_redundancy_after_exclusion: int = 4
    max_detectable_sigma: float | None = 15.0
    ambiguity_chi2_margin: float = 16.0
    max_sigma_fraction: float = 0.1

    _MAY_BE_ZERO = ("min_redundancy", "max_excluded", "min_redundancy_after_exclusion")

    @property
    def min_readings(self) -> int:
        """Smallest number of readings of a pose."""
        return POSE_PARAMETERS + self.min_redundancy


@dataclass(frozen=True)
class MotionSettings(_PositiveSettings):
    """Expected motion of tools: velocity and angular velocity change by white noise.

    Args:
        acceleration_mm_s2: RMS acceleration of a tool.
        angular_acceleration_rad_s2: RMS angular acceleration.
        manoeuvre_time_constant_s: duration of an acceleration. The noise of the velocity has the
            density 2 a^2 T of R. A. Singer's model (doi:10.1109/TAES.1970.4103889) for slower
            changes.
        velocity_sigma_mm_s: standard deviation of an unknown velocity.
        angular_velocity_sigma_rad_s: standard deviation of an unknown angular velocity.
        manoeuvre_factor: factor on the accelerations in the second attempt at a frame that does
            not fit.
    """

    acceleration_mm_s2: float = 3000.0
    angular_acceleration_rad_s2: float = 30.0
    manoeuvre_time_constant_s: float = 0.05
    velocity_sigma_mm_s: float = 500.0
    angular_velocity_sigma_rad_s: float = 5.0
    manoeuvre_factor: float = 10.0


@dataclass(frozen=True)
class MotionMode(_PositiveSettings):
    """A motion model of a tool.

    Args:
        acceleration_fraction: fraction of the RMS accelerations of MotionSettings.
        manoeuvre_time_constant_s: duration of an acceleration that is estimated too: it changes by
            white noise of the density ``2 a^2 / T``. None: accelerations are too short for that,
            the velocities change by white noise as in MotionSettings.
    """

    acceleration_fraction: float
    manoeuvre_time_constant_s: float | None = None


@dataclass(frozen=True)
class ImmSettings(_PositiveSettings):
    """Motion models of a strobed tool, which run in parallel.

    Args:
        modes: at rest, slow, steady, fast, and the largest expected accelerations.
        mean_sojourn_s: mean time in one of them.
    """

    modes: tuple[MotionMode, ...] = (
        MotionMode(1e-4),
        MotionMode(0.03),
        MotionMode(0.2, 0.3),
        MotionMode(0.6, 0.3),
        MotionMode(1.0),
    )
    mean_sojourn_s: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.modes or self.modes[-1] != MotionMode(1.0):
            raise InvalidParameter(
                f"modes are {self.modes}; the last one must be {MotionMode(1.0)}: readings are "
                "looked for as far as it reaches"
            )


@dataclass(frozen=True)
class LabellingSettings(_PositiveSettings):
    """Tolerances of the identification of tools by their geometry.

    Args:
        min_markers: smallest number of markers that identify a tool; three make a triangle.
        gate_probability: probability that a correct distance is outside the gate.
        marker_sigma_mm: standard deviation of a marker's position in the tool, in addition to the
            covariance of the point.
        ambiguity_chi2_margin: two assignments fit equally well when their chi2 differ by less.
        max_search_steps: largest number of search steps, after which the tool is not found: for a
            tool of 20 equal distances the search would not end.
    """

    min_markers: int = 3
    gate_probability: float = 1e-5
    marker_sigma_mm: float = 0.1
    ambiguity_chi2_margin: float = 16.0
    max_search_steps: int = 20_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_markers < 3:
            raise InvalidParameter(
                f"min_markers is {self.min_markers}; it must be 3 or more: two points fit any "
                "tool turned about the line through them"
            )


@dataclass(frozen=True)
class ToolTrackerSettings(_PositiveSettings):
    """Settings of a tool tracker, and the limits of a usable pose.

    Args:
        fit: limits of poses from readings alone.
        motion: motion between frames.
        imm: motion models of tools whose markers are strobed.
        labelling: identification of tools whose markers are lit together.
        gate_probability: probability that a correct reading is outside the gate.
        resolution_px: stripes closer than this may be one peak; about twice their width.
        coast_s: longest time that a pose is predicted without readings; then it is MISSING.
        acquisition_window_s: largest age of the exposures that a strobed tool is found from.
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR, for
            tools without a limit of their own.
        volume_mm: lowest and highest corner of the calibrated volume, in world coordinates [mm];
            None: unknown.
    """

    fit: PoseFitSettings = PoseFitSettings()
    motion: MotionSettings = MotionSettings()
    imm: ImmSettings = ImmSettings()
    labelling: LabellingSettings = LabellingSettings()
    gate_probability: float = 1e-5
    resolution_px: float = 4.0
    coast_s: float = 0.1
    acquisition_window_s: float = 0.25
    max_tip_sd_mm: float = 1.0
    volume_mm: tuple[Vector3, Vector3] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.volume_mm is not None:
            low, high = self.volume_mm
            if not all(-inf < a < b < inf for a, b in zip(low, high, strict=True)):
                raise InvalidParameter(
                    f"volume_mm is {self.volume_mm}; its first corner must lie below its second"
                )
