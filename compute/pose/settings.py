"""Settings of pose fits and of tool trackers; the defaults are for live use."""

from dataclasses import dataclass, fields
from math import inf, isfinite
from typing import Final

from compute.camera.model import Vector3
from compute.errors import InvalidParameter

POSE_PARAMETERS: Final = 6


def _check_positive(settings: object, *, but: tuple[str, ...] = ()) -> None:
    for field in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, field.name)
        if field.name in but or not isinstance(value, int | float):
            continue
        if not (isfinite(value) and value > 0.0):
            raise InvalidParameter(
                f"{field.name} is {value}; it must be positive", **{field.name: value}
            )


@dataclass(frozen=True)
class PoseFitSettings:
    """When a fit of readings is a pose.

    Args:
        min_redundancy: readings beyond the six that a pose takes. With none the fit is exact
            and says nothing of whether the readings are right.
        false_rejection_probability: chance that right readings are taken for wrong ones.
        max_excluded: wrong readings that are left out at most.
        ambiguity_chi2_margin: two solutions fit equally well when their chi2 differ by less: at 16
            the worse one is 3,000 times less likely.
        max_sigma_fraction: largest standard deviation of any motion, in mm at the tool's own
            radius, as a share of that radius. Above it the linear covariance means nothing: at 0.1
            the second-order term of a turn is a twentieth of the turn.
    """

    min_redundancy: int = 1
    false_rejection_probability: float = 1e-4
    max_excluded: int = 1
    ambiguity_chi2_margin: float = 16.0
    max_sigma_fraction: float = 0.1

    def __post_init__(self) -> None:
        _check_positive(self, but=("min_redundancy", "max_excluded"))
        for name in ("min_redundancy", "max_excluded"):
            if getattr(self, name) < 0:
                raise InvalidParameter(f"{name} is {getattr(self, name)}; it must be 0 or more")

    @property
    def min_readings(self) -> int:
        """Fewest readings that make a pose."""
        return POSE_PARAMETERS + self.min_redundancy


@dataclass(frozen=True)
class MotionSettings:
    """How tools are expected to move: velocity and angular velocity change by white noise.

    Args:
        acceleration_mm_s2: RMS acceleration of a tool.
        angular_acceleration_rad_s2: RMS angular acceleration.
        manoeuvre_time_constant_s: time for which an acceleration lasts. The noise of the velocity
            has the density 2 a^2 T of R. A. Singer's model (doi:10.1109/TAES.1970.4103889) for
            slower changes.
        velocity_sigma_mm_s: standard deviation of a velocity of which nothing is known.
        angular_velocity_sigma_rad_s: of an angular velocity of which nothing is known.
        manoeuvre_factor: factor on the accelerations with which a frame that does not fit is tried
            again.
    """

    acceleration_mm_s2: float = 3000.0
    angular_acceleration_rad_s2: float = 30.0
    manoeuvre_time_constant_s: float = 0.05
    velocity_sigma_mm_s: float = 500.0
    angular_velocity_sigma_rad_s: float = 5.0
    manoeuvre_factor: float = 10.0

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class MotionMode:
    """One of the ways in which a tool is moved at a time.

    Args:
        acceleration_fraction: of the RMS accelerations of MotionSettings.
        manoeuvre_time_constant_s: how long an acceleration lasts, if so long that it is followed as
            well: it then changes by white noise of the density ``2 a^2 / T``. None: it is too short
            for that, the velocities change by white noise as in MotionSettings.
    """

    acceleration_fraction: float
    manoeuvre_time_constant_s: float | None = None

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class ImmSettings:
    """The modes that a tool whose markers are strobed is followed in at once.

    Args:
        modes: at rest, moved gently, steadily, quickly, and at the most that is expected.
        mean_sojourn_s: time that it keeps to one of them, in the mean.
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
        _check_positive(self)
        if not self.modes or self.modes[-1] != MotionMode(1.0):
            raise InvalidParameter(
                f"modes are {self.modes}; the last one must be {MotionMode(1.0)}: readings are "
                "looked "
                "for as far as it reaches"
            )


@dataclass(frozen=True)
class LabellingSettings:
    """How tools are told by their geometry.

    Args:
        min_markers: fewest markers that a tool is known by; three make a triangle.
        gate_probability: chance that markers of the tool are not taken for it, per distance.
        marker_sigma_mm: standard deviation of a point on top of its covariance: how well the
            markers' places in the tool are known.
        ambiguity_chi2_margin: two ways to explain points are equally good when their chi2 differ by
            less.
        max_search_steps: steps of the search for ways to lay a tool over points, after which it
            gives up
            and the tool is not found: of a tool of 20 like distances there is no end.
    """

    min_markers: int = 3
    gate_probability: float = 1e-5
    marker_sigma_mm: float = 0.1
    ambiguity_chi2_margin: float = 16.0
    max_search_steps: int = 20_000

    def __post_init__(self) -> None:
        _check_positive(self)
        if self.min_markers < 3:
            raise InvalidParameter(
                f"min_markers is {self.min_markers}; it must be 3 or more: two points fit any "
                "tool turned about the line through them"
            )


@dataclass(frozen=True)
class ToolTrackerSettings:
    """How tools are tracked, and when a pose is good enough to use.

    Args:
        fit: of poses from readings alone.
        motion: between frames.
        imm: of the motion of tools whose markers are strobed.
        labelling: of tools whose markers are lit together.
        gate_probability: chance that a right reading is not taken for its marker.
        resolution_px: lines nearer to one another may be one peak; about twice their width.
        coast_s: longest time that a pose rests on prediction alone; then it is MISSING.
        acquisition_window_s: exposures of a strobed tool that it is found from are no older.
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR, of
            tools that have no limit of their own.
        volume_mm: lowest and highest corner of the volume that the calibration vouches for, in
            world coordinates [mm]; None: not known.
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
        _check_positive(self)
        if self.volume_mm is not None:
            low, high = self.volume_mm
            if not all(-inf < a < b < inf for a, b in zip(low, high, strict=True)):
                raise InvalidParameter(
                    f"volume_mm is {self.volume_mm}; its first corner must lie below its second"
                )
