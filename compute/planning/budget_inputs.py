"""Inputs of an accuracy budget: what a profile says of error sources, typical values elsewhere."""

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields

from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.error_sources import LED_DEPTH, RETRO_DEPTH, TYPICAL, ErrorSources
from compute.optics.profiles.profile_sections import RetroMarkers


@dataclass(frozen=True)
class BudgetInput:
    """One value that an accuracy budget rests on.

    Args:
        name: the field of a profile's ``error_sources``, without its unit.
        value: in that unit.
        unit: empty for what has none.
        assumed: nobody measured or published it of this device.
        source: where it is from, or the argument for it.
    """

    name: str
    value: float | str | tuple[float, ...]
    unit: str
    assumed: bool
    source: str


@dataclass(frozen=True)
class BudgetInputs:
    """All inputs of a budget.

    Args:
        by_field: by the names of the fields of ``ErrorSources``.
        assumed_sections: other sections of the profile of which something is assumed.
    """

    by_field: dict[str, BudgetInput]
    assumed_sections: frozenset[str]

    @classmethod
    def of(cls, profile: DeviceProfile) -> "BudgetInputs":
        """Return what a profile says, and typical values for the rest."""
        # Here, so that nobody pays for pint who plans nothing.
        from compute.optics.profiles.units import split_unit

        depth = RETRO_DEPTH if isinstance(profile.markers, RetroMarkers) else LED_DEPTH
        typical = {**TYPICAL, "optical_centre_depth_mm": depth}
        inputs = {}
        for name in (field.name for field in fields(ErrorSources)):
            stated = getattr(profile.error_sources, name)
            short, unit = split_unit(name)
            path = f"error_sources.{short}"
            unit_name = "" if unit is None else unit.name
            if stated is not None:
                reason = profile.assumed.get(path)
                source = reason or "given"
                inputs[name] = BudgetInput(short, stated, unit_name, reason is not None, source)
            elif name in typical:
                one = typical[name]
                inputs[name] = BudgetInput(short, one.value, unit_name, True, one.source)
        sections = frozenset(re.split(r"[.\[]", path)[0] for path in profile.assumed)
        return cls(inputs, sections)

    def number(self, name: str) -> float:
        """Return a numeric input by the name of its field, in the unit of that name."""
        value = self.by_field[name].value
        assert isinstance(value, int | float)
        return float(value)

    def choice(self, name: str) -> str:
        """Return an input that is one of several words."""
        value = self.by_field[name].value
        assert isinstance(value, str)
        return value

    def assumed(self, names: Iterable[str]) -> bool:
        """Return whether any of these fields and sections is assumed."""
        return any(
            self.by_field[name].assumed if name in self.by_field else name in self.assumed_sections
            for name in names
        )

    def label(self, name: str) -> str:
        """Return what a profile calls a field or a section."""
        return self.by_field[name].name if name in self.by_field else name
