"""Assessment documents of a calibration: distortion and diagnosis."""

from dataclasses import dataclass

from compute.camera.model import Vector3


@dataclass(frozen=True)
class DistortionEstimate:
    """The distortion terms of a calibration, their size, and the reason for them.

    Args:
        chosen: "auto", the name of the set that was requested, or "terms" for terms that the
            request listed.
        reason: why, for people.
        scale: standard deviation of the coefficients' effect, as a share of half the field at its
            edge, common to the device's lenses; None: not estimated, the terms were requested.
        scale_range: its 5 % and 95 % points; None likewise.
        edge_px: the same scale at the edge of the pixels [px]; None likewise.
        log_evidence_ratio: natural logarithm of how many times as probable the readings are with
            distortion as without; None likewise.
    """

    chosen: str
    reason: str
    scale: float | None = None
    scale_range: tuple[float, float] | None = None
    edge_px: float | None = None
    log_evidence_ratio: float | None = None


@dataclass(frozen=True)
class SensorDiagnosis:
    """Precision of one sensor's parameters by the geometry of the control points.

    Args:
        sensor: its name.
        condition: smallest over largest singular value of its Jacobian with columns of length 1,
            seen from the points' centroid.
        weakest: the combination of parameters that is known worst, by name, with its share
            (squares add to 1), the largest first.
        weakest_description: what that combination is.
        pixels: lowest and highest reading [px].
        pixel_share: share of the sensor's pixels between them.
        field_u: smallest and largest x/z of the points.
        field_v: smallest and largest y/z; None where no reading depends on it.
        depth_mm: nearest and farthest depth of the points [mm].
    """

    sensor: str
    condition: float
    weakest: tuple[tuple[str, float], ...]
    weakest_description: str
    pixels: tuple[float, float]
    pixel_share: float
    field_u: tuple[float, float]
    field_v: tuple[float, float] | None
    depth_mm: tuple[float, float]


@dataclass(frozen=True)
class Suggestion:
    """A suggested further control point and the precision with it.

    Args:
        position_mm: its position, (3,) [mm].
        mean_sigma_mm: RMS over the volume of the reconstruction error due to the calibration [mm].
        max_sigma_mm: the largest such error [mm].
    """

    position_mm: Vector3
    mean_sigma_mm: float
    max_sigma_mm: float


@dataclass(frozen=True)
class Diagnosis:
    """Precision of a calibration by its control points, and the points that would improve it.

    Args:
        sensors: one for each sensor.
        mean_sigma_mm: RMS over the volume of a point's standard deviation due to the calibration
            (root of the trace of its covariance) [mm]; None with fewer than three sensors.
        max_sigma_mm: the largest [mm]; None likewise.
        suggestions: further points, the best first, each as if it were the only one.
        remarks: warnings for the user, in sentences.
    """

    sensors: tuple[SensorDiagnosis, ...]
    mean_sigma_mm: float | None
    max_sigma_mm: float | None
    suggestions: tuple[Suggestion, ...]
    remarks: tuple[str, ...]
