"""Assessment documents of a calibration: distortion selection and diagnosis."""

from dataclasses import dataclass

from compute.camera.field_distortion import Term
from compute.camera.model import Vector3


@dataclass(frozen=True)
class CandidateTerms:
    """One candidate set of distortion terms in the cross-validation.

    Args:
        name: the set's name, "none" without terms.
        terms: its terms.
        parameters: number of parameters fitted for each sensor.
        left_out_rms_px: RMS of readings predicted by fits without their block [px]; None: not
            fitted.
        loss: mean squared prediction error over its variance, all sensors together; None likewise.
        loss_excess: difference to the loss of the best set; None likewise.
        loss_excess_error: standard error of that difference, over the blocks; None likewise.
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
    """The distortion terms of a calibration and the reason for them.

    Args:
        chosen: the set's name; "terms" for terms that the request listed.
        reason: why, for people.
        candidates: the sets that were compared; empty without a comparison.
        blocks: number of blocks of space in the cross-validation; 0 without one.
        reduced_terms: sensors with too few points for the set, and the set that they have instead.
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
    """How well control points determine the calibration, and which others would help.

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
