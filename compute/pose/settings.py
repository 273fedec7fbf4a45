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
        least_redundancy: readings beyond the six that a pose takes. With none the fit is exact
            and says nothing of whether the readings are right.
        inconsistent_probability: chance that right readings are taken for wrong ones.
        most_left_out: wrong readings that are left out at most.
        distinct_chi2: two solutions fit equally well when their chi2 differ by less: at 16 the
            worse one is 3,000 times less likely.
        most_sd_share: largest standard deviation of any motion, in mm at the tool's own radius,
            as a share of that radius. Above it the linear covariance means nothing: at 0.1 the
            second-order term of a turn is a twentieth of the turn.
    """

    least_redundancy: int = 1
    inconsistent_probability: float = 1e-4
    most_left_out: int = 1
    distinct_chi2: float = 16.0
    most_sd_share: float = 0.1

    def __post_init__(self) -> None:
        _check_positive(self, but=("least_redundancy", "most_left_out"))
        for name in ("least_redundancy", "most_left_out"):
            if getattr(self, name) < 0:
                raise InvalidParameter(f"{name} is {getattr(self, name)}; it must be 0 or more")

    @property
    def least_readings(self) -> int:
        """Fewest readings that make a pose."""
        return POSE_PARAMETERS + self.least_redundancy


@dataclass(frozen=True)
class MotionSettings:
    """How tools are expected to move: velocity and angular velocity change by white noise.

    Args:
        acceleration_mm_s2: RMS acceleration of a tool.
        turn_acceleration_rad_s2: RMS angular acceleration.
        steady_s: time for which an acceleration lasts. The noise of the velocity has the density
            2 a^2 T of R. A. Singer's model (doi:10.1109/TAES.1970.4103889) for slower changes.
        speed_mm_s: standard deviation of a velocity of which nothing is known.
        turn_rate_rad_s: of an angular velocity of which nothing is known.
        manoeuvre: factor on the accelerations with which a frame that does not fit is tried again.
    """

    acceleration_mm_s2: float = 3000.0
    turn_acceleration_rad_s2: float = 30.0
    steady_s: float = 0.05
    speed_mm_s: float = 500.0
    turn_rate_rad_s: float = 5.0
    manoeuvre: float = 10.0

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class Regime:
    """One of the ways in which a tool is moved at a time.

    Args:
        share: of the RMS accelerations of MotionSettings.
        steady_s: how long an acceleration lasts, if so long that it is followed as well: it then
            changes by white noise of the density ``2 a^2 / T``. None: it is too short for that,
            the velocities change by white noise as in MotionSettings.
    """

    share: float
    steady_s: float | None = None

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class RegimeSettings:
    """The regimes that a tool whose markers are strobed is followed in at once.

    Args:
        kinds: at rest, moved gently, steadily, quickly, and at the most that is expected.
        mean_s: time that it keeps to one of them, in the mean.
    """

    kinds: tuple[Regime, ...] = (
        Regime(1e-4),
        Regime(0.03),
        Regime(0.2, 0.3),
        Regime(0.6, 0.3),
        Regime(1.0),
    )
    mean_s: float = 0.3

    def __post_init__(self) -> None:
        _check_positive(self)
        if not self.kinds or self.kinds[-1] != Regime(1.0):
            raise InvalidParameter(
                f"kinds are {self.kinds}; the last one must be {Regime(1.0)}: readings are looked "
                "for as far as it reaches"
            )


@dataclass(frozen=True)
class IdentifySettings:
    """How tools are told by their geometry.

    Args:
        least_markers: fewest markers that a tool is known by; three make a triangle.
        gate_probability: chance that markers of the tool are not taken for it, per distance.
        noise_mm: standard deviation of a point on top of its covariance: how well the markers'
            places in the tool are known.
        distinct_chi2: two ways to explain points are equally good when their chi2 differ by less.
        most_ways: steps of the search for ways to lay a tool over points, after which it gives up
            and the tool is not found: of a tool of 20 like distances there is no end.
    """

    least_markers: int = 3
    gate_probability: float = 1e-5
    noise_mm: float = 0.1
    distinct_chi2: float = 16.0
    most_ways: int = 20_000

    def __post_init__(self) -> None:
        _check_positive(self)
        if self.least_markers < 3:
            raise InvalidParameter(
                f"least_markers is {self.least_markers}; it must be 3 or more: two points fit any "
                "tool turned about the line through them"
            )


@dataclass(frozen=True)
class ToolTrackerSettings:
    """How tools are tracked, and when a pose is good enough to use.

    Args:
        fit: of poses from readings alone.
        motion: between frames.
        regimes: of the motion of tools whose markers are strobed.
        identify: of tools whose markers are lit together.
        gate_probability: chance that a right reading is not taken for its marker.
        merge_px: lines nearer to one another may be one peak; about twice their width.
        coast_s: longest time that a pose rests on prediction alone; then it is MISSING.
        window_s: exposures of a strobed tool that it is found from are no older.
        most_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR, of
            tools that have no limit of their own.
        volume_mm: lowest and highest corner of the volume that the calibration vouches for, in
            world coordinates [mm]; None: not known.
    """

    fit: PoseFitSettings = PoseFitSettings()
    motion: MotionSettings = MotionSettings()
    regimes: RegimeSettings = RegimeSettings()
    identify: IdentifySettings = IdentifySettings()
    gate_probability: float = 1e-5
    merge_px: float = 4.0
    coast_s: float = 0.1
    window_s: float = 0.25
    most_tip_sd_mm: float = 1.0
    volume_mm: tuple[Vector3, Vector3] | None = None

    def __post_init__(self) -> None:
        _check_positive(self)
        if self.volume_mm is not None:
            low, high = self.volume_mm
            if not all(-inf < a < b < inf for a, b in zip(low, high, strict=True)):
                raise InvalidParameter(
                    f"volume_mm is {self.volume_mm}; its first corner must lie below its second"
                )
