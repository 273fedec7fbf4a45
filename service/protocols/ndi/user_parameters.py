"""User parameters: what GET reads and SET changes, for one client."""

from dataclasses import dataclass
from typing import Final

from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.identity import API_REVISION, Identity
from service.protocols.ndi.port_handles import MAX_HANDLES

_MAX_TEXT: Final = 255


@dataclass(frozen=True)
class _Range:
    min_value: int
    max_value: int


_TEXTS: Final = tuple(f"Param.User.String{number}" for number in range(5))
_NUMBERS: Final = {
    # What drivers set as a matter of course; what has one value only cannot be otherwise here.
    "Param.Tracking.Track Frequency": (2, _Range(2, 2)),
    "Param.Tracking.Selected Volume": (0, _Range(0, 0)),
    "Param.Data Averaging.Depth": (1, _Range(1, 1)),
    "Param.Default Wavelength.Return Warning": (0, _Range(0, 1)),
    "Param.System Beeper": (1, _Range(0, 1)),
}


class UserParameters:
    """The parameters of one client; none of them changes what is measured."""

    def __init__(self, identity: Identity) -> None:
        self._fixed = {
            "Features.Firmware.Version": identity.version,
            "Features.Firmware.API Revision": API_REVISION,
            "Features.Hardware.Model": identity.model,
            "Features.Hardware.Serial Number": identity.serial,
            "Features.Tools.Enabled Tools": str(MAX_HANDLES),
        }
        self._values = {name: str(value) for name, (value, _) in _NUMBERS.items()}
        self._values |= dict.fromkeys(_TEXTS, "")

    def get(self, name: str, frame_rate_hz: float) -> str:
        """Return the lines ``name=value`` of a parameter, or of all that begin as before ``*``.

        Raises:
            Refused: there is none.
        """
        found = self._fixed | self._values
        found["Param.Tracking.Frame Frequency"] = str(round(frame_rate_hz))
        if name.endswith("*"):
            chosen = sorted(one for one in found if one.startswith(name[:-1]))
        else:
            chosen = [name] if name in found else []
        if not chosen:
            raise CommandError(ErrorCode.NO_SUCH_PARAMETER)
        return "\n".join(f"{one}={found[one]}" for one in chosen)

    def set(self, assignment: str) -> None:
        """Set a parameter: ``name=value``; raises Refused."""
        name, equals, value = assignment.partition("=")
        if not equals:
            raise CommandError(ErrorCode.WRONG_PARAMETERS)
        if name in self._fixed or name == "Param.Tracking.Frame Frequency":
            raise CommandError(ErrorCode.READ_ONLY)
        if name not in self._values:
            raise CommandError(ErrorCode.NO_SUCH_PARAMETER)
        if name in _NUMBERS:
            value = _checked(value, _NUMBERS[name][1])
        elif len(value) > _MAX_TEXT or not value.isprintable():
            raise CommandError(ErrorCode.VALUE_OUT_OF_RANGE)
        self._values[name] = value


def _checked(value: str, limits: _Range) -> str:
    digits = value.removeprefix("-")
    if not digits.isdecimal():
        raise CommandError(ErrorCode.WRONG_VALUE_TYPE)
    if len(digits) > 9 or not limits.min_value <= int(value) <= limits.max_value:
        raise CommandError(ErrorCode.VALUE_OUT_OF_RANGE)
    return str(int(value))
