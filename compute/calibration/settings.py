"""CalibrationSettings: distortion, uncertainty of control points, loss, label errors."""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from compute.calibration.single_sensor.distortion_terms import Preset, check_order, preset_terms
from compute.camera.field_distortion import Term, check_terms
from compute.errors import InvalidParameter

Loss = Literal["linear", "robust"]
LabelPolicy = Literal["off", "report", "exclude", "repair"]
Distortion = Literal["none", "auto"] | Preset | tuple[Term, ...]

CONTROL_SIGMA_RANGE_MM: Final = (1e-6, 1e3)


@dataclass(frozen=True)
class CalibrationSettings:
    """How a device is calibrated.

    Args:
        distortion: "none"; "auto": selected by cross-validation
            (``compute.calibration.distortion_selection``); a set's name
            (``compute.calibration.single_sensor.distortion_terms``); or the terms themselves.
        control_sigma_mm: standard deviation of each coordinate of the control points [mm]; None:
            exact. With it the points are unknowns too, and the covariance of the sensors is joint.
        loss: "linear": least squares. "robust": outliers lose their weight
            (``compute.robust_statistics``).
        labels: policy for wrong and exchanged labels: "off" (no search), "report", "exclude" or
            "repair".

    Raises:
        InvalidParameter: a value is out of range or unknown.
    """

    distortion: Distortion = "none"
    control_sigma_mm: float | None = None
    loss: Loss = "linear"
    labels: LabelPolicy = "off"

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("loss", self.loss, get_args(Loss)),
            ("labels", self.labels, get_args(LabelPolicy)),
        ):
            if value not in allowed:
                raise InvalidParameter(
                    f'{name} is "{value}"; it must be one of {", ".join(allowed)}', **{name: value}
                )
        if not isinstance(self.distortion, str):
            check_terms(self.distortion)
            check_order(self.distortion)
        elif self.distortion not in ("none", "auto"):
            preset_terms(self.distortion)
        sigma = self.control_sigma_mm
        low, high = CONTROL_SIGMA_RANGE_MM
        if sigma is not None and not (np.isfinite(sigma) and low <= sigma <= high):
            raise InvalidParameter(
                f"control_sigma_mm is {sigma}; it must lie in {low:g} .. {high:g} mm, or be left "
                "out for exact points",
                control_sigma_mm=sigma,
            )


DEFAULTS: Final = CalibrationSettings()
"""The metric camera without distortion, of exact points, by least squares."""
