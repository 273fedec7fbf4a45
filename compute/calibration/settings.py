"""What a calibration run is asked to do."""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from compute.calibration.single_sensor.distortion_terms import Preset, check_order, preset_terms
from compute.camera.field_distortion import Term, check_terms
from compute.errors import InvalidParameter

Method = Literal["metric", "dlt-iterative", "bundle-11"]
Loss = Literal["linear", "robust"]
LabelPolicy = Literal["off", "report", "exclude", "repair"]
Distortion = Literal["none", "auto"] | Preset | tuple[Term, ...]

CONTROL_SIGMA_RANGE_MM: Final = (1e-6, 1e3)


@dataclass(frozen=True)
class CalibrationSettings:
    """How a device is calibrated.

    Args:
        method: "metric": the seven-parameter camera with distortion. "dlt-iterative": the
            thesis's [5.1]-[5.12] as published; "bundle-11": its bundle adjustment over eleven
            parameters by steps, [5.21]-[5.29]; both for comparison, with no other setting but
            ``labels``.
        distortion: "none"; "auto": the set that predicts blocks of points it never saw best
            (``compute.calibration.distortion_selection``); a set's name (``compute.calibration.single_sensor.distortion_terms``); or
            the terms themselves.
        control_sigma_mm: standard deviation of each coordinate of the control points [mm];
            None: they are exact. With it the points are unknowns too, which makes the
            covariance of the sensors joint.
        loss: "linear": least squares. "robust": outliers lose their weight
            (``compute.calibration.single_sensor.m_estimators``).
        labels: what is done with wrong and exchanged labels: not looked for, reported, left out,
            or mended.

    Raises:
        InvalidParameter: a setting that means nothing, or contradicts another.
    """

    method: Method = "metric"
    distortion: Distortion = "none"
    control_sigma_mm: float | None = None
    loss: Loss = "linear"
    labels: LabelPolicy = "off"

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("method", self.method, get_args(Method)),
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
        if self.method != "metric":
            self._check_published()

    def _check_published(self) -> None:
        given = {
            "distortion": self.distortion != "none",
            "control_sigma_mm": self.control_sigma_mm is not None,
            "loss": self.loss != "linear",
        }
        for name, extra in given.items():
            if extra:
                raise InvalidParameter(
                    f"{name} is {getattr(self, name)!r} with the method {self.method}, which is "
                    f'taken as published and has no such setting; leave it out, or use "metric"',
                    **{name: getattr(self, name)},
                )


DEFAULTS: Final = CalibrationSettings()
"""The metric camera without distortion, of exact points, by least squares."""
