"""What a search for label errors in control data says."""

from dataclasses import dataclass

from compute.calibration.mislabels.finding import LabelFinding


@dataclass(frozen=True)
class LabelReport:
    """The label errors of a device's control data.

    Args:
        findings: the errors, those of all sensors first, then sensor by sensor.
        sigma_px: standard deviation of a reading that each sensor's search ended with [px].
        explanation_probability: for each sensor, probability of the explanation that the findings make together;
            low where others explain its readings about as well.
    """

    findings: tuple[LabelFinding, ...]
    sigma_px: tuple[float, ...]
    explanation_probability: tuple[float, ...]
