"""Settings of the search and the fit of shadows."""

from dataclasses import dataclass

from compute.errors import InvalidParameter


@dataclass(frozen=True)
class ShadowSettings:
    """How shadows are found and fitted.

    Args:
        fit_scale: fit the shadow's magnification too. A shadow is 1 + gap / Z as wide as the
            code, so one template fits one distance; with its scale free it fits others, and the
            position costs more noise where the pattern lies to one side of the reading.
        false_alarms_per_line: most false readings to be expected of a scan without a shadow.
        ambiguity_probability: a shadow is ambiguous where another place is this much as likely.
        misfit_probability: a fit is poor where chance alone makes its chi-square as rarely as this.

    Raises:
        InvalidParameter: a value outside its range.
    """

    fit_scale: bool = False
    false_alarms_per_line: float = 1e-3
    ambiguity_probability: float = 1e-4
    misfit_probability: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("false_alarms_per_line", "ambiguity_probability", "misfit_probability"):
            value = float(getattr(self, name))
            if not 0.0 < value < 1.0:
                raise InvalidParameter(
                    f"{name} is {value}; it must lie between 0 and 1", **{name: value}
                )
