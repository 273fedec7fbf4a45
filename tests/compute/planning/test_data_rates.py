"""Rates: the thesis's formulas and values."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.planning.data_rates import Illumination, rates


@pytest.mark.parametrize(
    ("markers", "line_rate_hz", "marker_rate_hz"),
    [
        (8, 2900.0, 362.5),  # Leo and Macellari 1981: 359 Hz, section 2.3
        (8, 9000.0, 1125.0),  # Macellari 1983: "1.1 kHz when 8 targets"
        (5, 2500.0, 500.0),  # Bianchi 1990: 5 markers at 500/s
        (50, 2500.0, 50.0),  # ... up to 50 at 50/s
        (28, 5600.0, 200.0),  # CODA mpx30, section 2.4
    ],
)
def test_published_strobed_rates(markers: int, line_rate_hz: float, marker_rate_hz: float) -> None:
    found = rates(markers, line_rate_hz, "strobed", sensors=3, pixels=2048, bits=12)
    assert found.marker_rate_hz == pytest.approx(marker_rate_hz)
    assert found.points_per_s == line_rate_hz


def test_the_sensor_of_section_3_2() -> None:
    """8192 pixels at 18 kHz make 147.5 MB/s at a byte a pixel."""
    found = rates(1, 18_000.0, "simultaneous", sensors=1, pixels=8192, bits=8)
    assert found.raw_bytes_per_s == pytest.approx(147.5e6, rel=1e-3)
    assert found.raw_pixels_per_s == found.raw_bytes_per_s


@given(
    st.integers(1, 300), st.floats(1.0, 1e5), st.integers(1, 12), st.integers(1, 20_000),
    st.integers(1, 32), st.sampled_from(["strobed", "simultaneous"]),
)  # fmt: skip
def test_the_formulas(
    markers: int, line_rate: float, sensors: int, pixels: int, bits: int, how: Illumination
) -> None:
    found = rates(markers, line_rate, how, sensors=sensors, pixels=pixels, bits=bits)
    assert found.points_per_s == pytest.approx(markers * found.marker_rate_hz)
    if how == "simultaneous":
        assert found.points_per_s == pytest.approx(markers * line_rate)  # [3.1]
        assert found.marker_rate_hz == line_rate  # [3.2]
    else:
        assert found.marker_rate_hz == pytest.approx(line_rate / markers)  # [3.3]
    bytes_of_a_pixel = found.raw_bytes_per_s / found.raw_pixels_per_s
    assert bytes_of_a_pixel == pytest.approx(round(bytes_of_a_pixel))
    assert bits <= 8 * round(bytes_of_a_pixel) < bits + 8
    assert found.reduced_bytes_per_s == pytest.approx(found.points_per_s * sensors * 8)
    assert found.reduction == pytest.approx(found.raw_bytes_per_s / found.reduced_bytes_per_s)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("markers", 0), ("sensors", 0), ("pixels", 0), ("bits", 0), ("bits", 33),
        ("line_rate_hz", 0.0), ("line_rate_hz", float("inf")), ("illumination", "dark"),
    ],
)  # fmt: skip
def test_what_is_refused(name: str, value: object) -> None:
    given = {
        "markers": 2, "line_rate_hz": 1000.0, "illumination": "strobed", "sensors": 4,
        "pixels": 2048, "bits": 12,
    }  # fmt: skip
    with pytest.raises(InvalidParameter) as refused:
        rates(**(given | {name: value}))  # type: ignore[arg-type]
    assert name in refused.value.context
    assert str(value) in refused.value.detail
