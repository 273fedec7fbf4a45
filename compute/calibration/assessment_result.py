"""What a calibration run says of its result beside the parameters: choices and advice."""

from dataclasses import dataclass

from compute.camera.field_distortion import Term
from compute.camera.model import Vector3


@dataclass(frozen=True)
class CandidateTerms:
    """One set of distortion terms in the cross-validation that chose.

    Args:
        name: the set's name, "none" without terms.
        terms: its terms.
        parameters: fitted for each sensor.
        left_out_rms_px: RMS of readings predicted by cameras that never saw their block [px];
            None where it could not be fitted.
        loss: mean squared prediction error over its variance, all sensors together; None too.
        loss_excess: by how much that is above the best set's.
        loss_excess_error: the standard error of that difference, over the blocks.
        note: why it was not fitted; empty if it was.
    """

    name: str
    terms: tuple[Term, ...]
    parameters: int
    left_out_rms_px: float | None
    loss: float | None
    loss_excess: float | None
    loss_excess_error: float | None
    note: str = ""


@dataclass(frozen=True)
class DistortionSelection:
    """Which distortion terms a run took, and why.

    Args:
        chosen: the set's name; "terms" for terms that were given.
        reason: in words.
        candidates: what was compared; empty where nothing was to choose.
        blocks: into how many blocks of space the points were cut for it; 0 likewise.
        reduced_terms: sensors that saw too few points for the set, and what they were given instead.
    """

    chosen: str
    reason: str
    candidates: tuple[CandidateTerms, ...] = ()
    blocks: int = 0
    reduced_terms: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class SensorDiagnosis:
    """How well the control points determine one sensor.

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
    """A further control point and what it would do.

    Args:
        position_mm: where.
        mean_sigma_mm: RMS over the volume of a point's deviation that the calibration causes,
            with it.
        max_sigma_mm: the largest such deviation, with it.
    """

    position_mm: Vector3
    mean_sigma_mm: float
    max_sigma_mm: float


@dataclass(frozen=True)
class Diagnosis:
    """What the control points leave open, and which measurement would help most.

    Args:
        sensors: one for each.
        mean_sigma_mm: RMS over the volume of a point's deviation that the calibration causes
            (root of the trace of its covariance) [mm]; None with fewer than three sensors.
        max_sigma_mm: the largest [mm]; None likewise.
        suggestions: further points, the best first, each as if it were the only one.
        remarks: what a person should know, in sentences.
    """

    sensors: tuple[SensorDiagnosis, ...]
    mean_sigma_mm: float | None
    max_sigma_mm: float | None
    suggestions: tuple[Suggestion, ...]
    remarks: tuple[str, ...]
