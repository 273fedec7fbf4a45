"""Quantities as text become numbers in a field's unit."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.optics.profiles.units import UNITS, InvalidQuantity, magnitude, split_unit

# Every unit a profile may use, with its size in the unit that the field's name carries.
SIZES = {
    "_mm": {"mm": "1", "m": "1000", "um": "1e-3", "µm": "1e-3", "nm": "1e-6", "in": "25.4"},
    "_um": {"um": "1", "mm": "1000", "nm": "1e-3", "micrometre": "1", "μm": "1"},
    "_nm": {"nm": "1", "um": "1000"},
    "_rad": {"rad": "1", "mrad": "1e-3"},
    "_hz": {"Hz": "1", "kHz": "1000", "MHz": "1e6", "1/s": "1", "1/ms": "1000"},
    "_s": {"s": "1", "ms": "1e-3", "us": "1e-6", "ns": "1e-9"},
    "_electrons": {"electron": "1", "electrons": "1", "kiloelectrons": "1000"},
    "_electrons_per_s": {"electrons/s": "1", "electrons/ms": "1000"},
    "_electrons_per_count": {"electrons/count": "1", "electron/count": "1"},
    "_counts": {"counts": "1", "count": "1"},
    "_w_per_sr": {"W/sr": "1", "mW/sr": "1e-3", "W / sr": "1"},
    "_mm_per_s": {"mm/s": "1", "m/s": "1000"},
    "_per_k": {"1/K": "1", "um/m/K": "1e-6"},
    "_k": {"K": "1", "mK": "1e-3"},
    "_px": {"px": "1", "pixel": "1"},
    "_per_sr": {"1/sr": "1", "cd/lx/m^2": "1", "cd/lx/mm^2": "1e6"},
}
WRITTEN = [(end, unit, size) for end, sizes in SIZES.items() for unit, size in sizes.items()]


def test_every_unit_of_a_field_is_tried() -> None:
    assert set(SIZES) == set(UNITS)


@pytest.mark.parametrize(("end", "unit", "size"), WRITTEN)
@settings(max_examples=30, deadline=None)
@given(value=st.floats(-1e12, 1e12, allow_subnormal=False))
def test_a_quantity_is_the_double_next_to_what_is_written(
    end: str, unit: str, size: str, value: float
) -> None:
    exact = Fraction(repr(value)) * Fraction(size)
    assert magnitude(f"{value!r} {unit}", UNITS[end]) == float(exact)


@settings(deadline=None)
@given(st.floats(-360.0, 360.0))
def test_degrees(value: float) -> None:
    assert magnitude(f"{value!r} deg", UNITS["_rad"]) == pytest.approx(np.radians(value), rel=1e-15)


@pytest.mark.parametrize("unit", UNITS.values(), ids=lambda unit: unit.name)
def test_the_example_of_a_message_is_right(unit: object) -> None:
    assert magnitude(unit.example, unit) > 0.0


@pytest.mark.parametrize("end", UNITS)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_a_unit_of_another_kind_is_refused(end: str, data: st.DataObject) -> None:
    others = [
        (unit, other)
        for other, sizes in SIZES.items()
        for unit in sizes
        if not (end in ("_mm", "_um", "_nm") and other in ("_mm", "_um", "_nm")) and other != end
    ]
    unit, _ = data.draw(st.sampled_from(others))
    with pytest.raises(InvalidQuantity, match=f'is no {UNITS[end].noun}; give an? .* such as "'):
        magnitude(f"1.5 {unit}", UNITS[end])


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("16.54", '"16.54" has no unit; give a length such as "16.54 mm"'),
        (16.54, '16.54 has no unit; give a length such as "16.54 mm"'),
        (4, '4 has no unit; give a length such as "16.54 mm"'),
        (True, "True is no quantity"),
        (["1 mm"], "is no quantity"),
        ("5 kHz", '"5 kHz" is no length; give a length such as "16.54 mm"'),
        ("2 mm^2", "is no length"),
        ("1/mm", "is not a number and a unit"),
        ("5 furlongs", "the unit furlongs is not known"),
        ("mm", "is not a number and a unit"),
        ("", "is not a number and a unit"),
        ("nan mm", "is not a number and a unit"),
        ("inf mm", "is not a number and a unit"),
        ("1e999 mm", "is too large"),
        ("1e9999999 mm", "is not a number and a unit"),
        ("2 * 3 mm", "is not a number and a unit"),
        ("1,5 mm", "is not a number and a unit"),
        ("1 mm +2 mm", "is not a number and a unit"),
        ("1 mm^99", "is not a number and a unit"),
        ("1 (mm)", "is not a number and a unit"),
    ],
)
def test_what_is_no_length_is_refused_with_what_would_be(value: object, why: str) -> None:
    with pytest.raises(InvalidQuantity) as caught:
        magnitude(value, UNITS["_mm"])
    assert why in str(caught.value)


@settings(deadline=None)
@given(st.text(max_size=30) | st.from_regex(r"[0-9.eE+-]{1,8} ?[a-zµ/*^0-9 ]{0,12}"))
def test_any_text_is_a_finite_length_or_refused(text: str) -> None:
    try:
        value = magnitude(text, UNITS["_mm"])
    except InvalidQuantity:
        return
    assert np.isfinite(value)


@pytest.mark.parametrize(
    ("name", "key", "unit"),
    [
        ("radius_mm", "radius", "mm"),
        ("pitch_um", "pitch", "um"),
        ("full_well_electrons", "full_well", "electron"),
        ("dark_current_electrons_per_s", "dark_current", "electron/s"),
        ("electrons_per_count", "electrons_per_count", "electron/count"),
        ("offset_counts", "offset", "count"),
        ("radiant_intensity_w_per_sr", "radiant_intensity", "W/sr"),
        ("retroreflection_per_sr", "retroreflection", "1/sr"),
        ("exposure_s", "exposure", "s"),
        ("sensors", "sensors", None),
        ("count", "count", None),
    ],
)
def test_a_fields_name_carries_its_unit(name: str, key: str, unit: str | None) -> None:
    found_key, found = split_unit(name)
    assert (found_key, found and found.name) == (key, unit)
