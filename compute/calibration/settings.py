"""CalibrationSettings, and the named sets of distortion terms (add one here)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from compute.camera.field_distortion import (
    Term,
    all_terms,
    check_terms,
    power_terms,
    symmetric_terms,
)
from compute.camera.model import PARAMETER_COUNT
from compute.errors import InvalidParameter

Preset = Literal[
    "odd-powers",
    "all-powers",
    "symmetric-3",
    "symmetric-5",
    "symmetric-7",
    "all-3",
    "all-5",
    "factory-19",
]

_FACTORY_19: Final[tuple[Term, ...]] = (
    *all_terms(3),
    (0, 4),
    (2, 2),
    (4, 0),
    *(term for term in symmetric_terms(5) if sum(term) == 5),
)

PRESETS: Final[dict[Preset, tuple[Term, ...]]] = {
    "odd-powers": power_terms(7, odd_only=True),
    "all-powers": power_terms(5, odd_only=False),
    "symmetric-3": symmetric_terms(3),
    "symmetric-5": symmetric_terms(5),
    "symmetric-7": symmetric_terms(7),
    "all-3": all_terms(3),
    "all-5": all_terms(5),
    "factory-19": _FACTORY_19,
}
"""Sets by name.

- odd-powers: u^3, u^5, u^7, the thesis's odd polynomial [2.12], [3.4]; K0 u of the balanced form
  [3.6] is the principal distance.
- all-powers: u^3, u^4, u^5, the thesis's polynomial of odd and even powers [2.13]; its u and u^2
  are what the camera's own parameters do.
- symmetric-3, -5, -7: odd in u and even in v, of a lens well centred.
- all-3, all-5: any lens.
- factory-19: eleven terms, which with seven camera parameters and the offset along the slit make
  the nineteen parameters a sensor of a factory calibration of the Optotrak kind: all of the third
  order, of the fourth those of a lens decentred along the row, and the symmetric ones of the
  fifth. Which nineteen the manufacturer takes is not published; these are ours.
"""

MAX_ORDER: Final = 9
"""Highest order i + j of a term to be fitted, two above the largest set's.

Half the field of view is below 0.5 (a wide lens), and 0.5^9 = 0.002.
"""

Loss = Literal["linear", "robust"]
LabelPolicy = Literal["off", "report", "exclude", "repair"]
Distortion = Literal["none", "auto"] | Preset | tuple[Term, ...]

WEAK_STRENGTH: Final = 0.3
"""Strength of the lenses' prior for terms that the user asked for: 30 % of half the field at its
edge is several times what lenses have; it holds only what the readings leave open."""

CONTROL_SIGMA_RANGE_MM: Final = (1e-6, 1e3)


def preset_terms(name: str) -> tuple[Term, ...]:
    """Return the terms of a named set; "none" has none.

    Raises:
        InvalidParameter: no set has this name.
    """
    for preset, terms in PRESETS.items():
        if preset == name:
            return terms
    if name == "none":
        return ()
    raise InvalidParameter(
        f'distortion is "{name}"; it must be "none", "auto", a list of terms, or one of '
        f"{', '.join(PRESETS)}",
        distortion=name,
    )


def check_order(terms: Sequence[Term]) -> None:
    """Check that no term has an order so high that its values vanish over any field of view.

    Raises:
        InvalidParameter: a term's powers add up to more than ``MAX_ORDER``.
    """
    for term in terms:
        if sum(term) > MAX_ORDER:
            raise InvalidParameter(
                f"distortion has u^{term[0]} v^{term[1]}, of the order {sum(term)}; the powers of "
                f"a term may add up to {MAX_ORDER}",
                terms=term,
            )


def depends_on_v(terms: tuple[Term, ...]) -> bool:
    """Return whether any term contains v, so that the lens offset along the slit is observable."""
    return any(j > 0 for _, j in terms)


def free_parameters(terms: tuple[Term, ...]) -> int:
    """Return the number of parameters of a sensor that are fitted with these terms."""
    check_terms(terms)
    return PARAMETER_COUNT + len(terms) + int(depends_on_v(terms))


@dataclass(frozen=True)
class CalibrationSettings:
    """Settings of a calibration.

    Args:
        distortion: "none"; "auto": all terms up to the fifth order, their scale estimated
            (``compute.calibration.single_sensor.distortion_scale``); the name of one of PRESETS;
            or the terms themselves.
        position_sigma_mm: standard deviation of each coordinate of the control points [mm]; None:
            exact. With it the points are unknowns too, and the covariance of the sensors is joint.
        loss: "linear": least squares. "robust": outliers lose their weight
            (``compute.robust_statistics``).
        labels: policy for exchanged and wrong labels and outliers: "off" (no search), "report",
            "exclude" or "repair", which leaves outliers out.

    Raises:
        InvalidParameter: a value is out of range or unknown.
    """

    distortion: Distortion = "none"
    position_sigma_mm: float | None = None
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
        elif self.distortion != "auto":
            preset_terms(self.distortion)
        sigma = self.position_sigma_mm
        low, high = CONTROL_SIGMA_RANGE_MM
        if sigma is not None and not (np.isfinite(sigma) and low <= sigma <= high):
            raise InvalidParameter(
                f"position_sigma_mm is {sigma}; it must lie in {low:g} .. {high:g} mm, or be left "
                "out for exact points",
                position_sigma_mm=sigma,
            )


DEFAULTS: Final = CalibrationSettings()
"""The metric camera without distortion, of exact points, by least squares."""
