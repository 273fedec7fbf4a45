"""Gray code and the plate that carries it: round trips, resolution, doubts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_code import from_bits, gray_decode, gray_encode, to_bits
from compute.optics.coded_aperture.gray_decoding import GrayFlag, read_gray
from compute.optics.coded_aperture.gray_plate import GrayPlate

MITCHELSON = GrayPlate()
SIGMA = 0.5 * MITCHELSON.cell_mm


@given(numbers=st.lists(st.integers(0, 2**62), min_size=1))
def test_decoding_undoes_encoding(numbers: list[int]) -> None:
    given_ = np.array(numbers, dtype=np.int64)
    np.testing.assert_array_equal(gray_decode(gray_encode(given_)), given_)


@given(number=st.integers(0, 2**62 - 1))
def test_neighbours_differ_in_one_bit(number: int) -> None:
    pair = gray_encode(np.array([number, number + 1]))
    assert bin(int(pair[0] ^ pair[1])).count("1") == 1


@given(number=st.integers(0, 2**20 - 1))
def test_bits_come_back(number: int) -> None:
    bits = to_bits(np.array(number), 20)
    assert int(from_bits(bits)) == number
    assert "".join("1" if bit else "0" for bit in bits) == f"{number:020b}"


def test_mitchelsons_plate_has_twelve_bits() -> None:
    assert MITCHELSON.bits == 12
    assert MITCHELSON.length_mm == 10.0  # thesis, section 2.3
    assert MITCHELSON.step_mm == pytest.approx(10.0 / 4096)
    assert MITCHELSON.quantisation_sigma_mm == pytest.approx(10.0 / 4096 / np.sqrt(12.0))
    assert MITCHELSON.transparent.shape == (256, MITCHELSON.tracks)


def test_each_cell_differs_from_the_next_in_one_gray_track() -> None:
    gray = MITCHELSON.transparent[:, : MITCHELSON.gray_bits]
    assert ((gray[1:] != gray[:-1]).sum(axis=1) == 1).all()
    assert len({tuple(row) for row in gray}) == 256


@settings(max_examples=30, deadline=None)
@given(at=st.floats(-1.0, 9.0), sigma=st.floats(0.05, 1.0))
def test_a_track_passes_the_light_on_its_zones(at: float, sigma: float) -> None:
    plate = GrayPlate(gray_bits=3, length_mm=8.0)
    outputs = plate.outputs(np.array(at), np.array(sigma))
    x = (np.arange(8000 * 4) + 0.5) / 4000  # the middles of 4000 pieces of each cell
    line = np.exp(-((x - at) ** 2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi))
    cells = line.reshape(8, -1).mean(axis=1)
    np.testing.assert_allclose(outputs, cells @ plate.transparent, atol=2e-6)


@settings(max_examples=100, deadline=None)
@given(
    at=st.floats(0.4, 9.6),
    cells=st.floats(0.2, 2.0),
    light=st.floats(1e-3, 1e9),
)
def test_the_position_is_read_to_its_step(at: float, cells: float, light: float) -> None:
    sigma = cells * MITCHELSON.cell_mm
    outputs = light * MITCHELSON.outputs(np.array([at]), np.array([sigma]))
    found = read_gray(MITCHELSON, outputs, line_sigma_mm=sigma)
    # Half a step of rounding, and what the table of the response leaves.
    assert abs(found.position_mm[0] - at) < 0.51 * MITCHELSON.step_mm
    assert found.code[0] == round(found.position_mm[0] / MITCHELSON.step_mm - 0.5)
    assert not found.flags[0] & (GrayFlag.NO_LIGHT | GrayFlag.INCONSISTENT)


def test_the_deviation_is_that_of_rounding() -> None:
    at = np.random.default_rng(1).uniform(0.3, 9.7, 20000)
    found = read_gray(
        MITCHELSON, MITCHELSON.outputs(at, np.full(20000, SIGMA)), line_sigma_mm=SIGMA
    )
    error = found.position_mm - at
    # 20000 draws know a deviation to 0.3 % (uniform: kurtosis 1.8).
    assert error.std() == pytest.approx(found.quantisation_sigma_mm, rel=0.015)


def test_a_track_near_its_threshold_is_named_and_does_no_harm() -> None:
    edge = 128 * MITCHELSON.cell_mm  # where the coarsest track turns
    at = (
        edge
        + np.array([-0.05, 0.0, 0.05, 1.0]) * SIGMA * np.array([1, 1, 1, 0])
        + [
            0.0,
            0.0,
            0.0,
            0.5 * MITCHELSON.cell_mm,
        ]
    )
    found = read_gray(MITCHELSON, MITCHELSON.outputs(at, np.full(4, SIGMA)), line_sigma_mm=SIGMA)
    assert found.ambiguous[:, 0].tolist() == [True, True, True, False]
    assert not found.ambiguous[:3, 1:].any()
    assert (found.flags[:3] == GrayFlag.AMBIGUOUS_TRACK).all()
    assert abs(found.position_mm - at).max() < 0.51 * MITCHELSON.step_mm


def test_a_broken_track_is_found_out_in_half_of_the_places() -> None:
    """A false bit mirrors the cell: an odd number of cells, which may look like one."""
    at = np.random.default_rng(4).uniform(0.5, 9.5, 4000)
    outputs = MITCHELSON.outputs(at, np.full(4000, SIGMA))
    sound = read_gray(MITCHELSON, outputs, line_sigma_mm=SIGMA)
    assert not (sound.flags & GrayFlag.INCONSISTENT).any()
    sine, broken = MITCHELSON.gray_bits, 3
    outputs[:, broken] = outputs[:, sine] + outputs[:, sine + 1] - outputs[:, broken]
    found = read_gray(MITCHELSON, outputs, line_sigma_mm=SIGMA)
    assert (found.flags & GrayFlag.INCONSISTENT != 0).mean() == pytest.approx(0.5, abs=0.05)


def test_no_light_no_position() -> None:
    outputs = MITCHELSON.outputs(np.array([5.0, np.nan, 400.0]), np.full(3, SIGMA))
    found = read_gray(MITCHELSON, outputs, line_sigma_mm=SIGMA)
    assert np.isnan(found.position_mm).tolist() == [False, True, True]
    assert (found.flags[1:] == GrayFlag.NO_LIGHT).all()
    assert found.code[1:].tolist() == [-1, -1]
    faint = read_gray(MITCHELSON, outputs, line_sigma_mm=SIGMA, min_signal=2.0)
    assert (faint.flags == GrayFlag.NO_LIGHT).all()


def test_footprints_are_the_tracks_and_linear_in_the_light() -> None:
    at = np.array([[2.0, np.nan], [7.5, 3.0]])
    sigma = np.full((2, 2), SIGMA)
    one = MITCHELSON.solid_angles(at, sigma, np.full((2, 2), 1e-4))
    assert one.first_px.dtype == np.int64
    assert not one.first_px.any()
    assert one.solid_angle_sr.shape == (2, 2, MITCHELSON.tracks)
    two = MITCHELSON.solid_angles(at, sigma, np.full((2, 2), 2e-4))
    np.testing.assert_allclose(two.solid_angle_sr, 2.0 * one.solid_angle_sr)
    assert not one.solid_angle_sr[0, 1].any()
    unseen = MITCHELSON.solid_angles(at, sigma, np.array([[1e-4, np.nan], [1e-4, 1e-4]]))
    np.testing.assert_array_equal(unseen.solid_angle_sr, one.solid_angle_sr)
    sine = MITCHELSON.gray_bits
    np.testing.assert_allclose(one.solid_angle_sr[1, :, sine : sine + 2].sum(axis=-1), 1e-4)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gray_bits", 1),
        ("gray_bits", 13),
        ("analogue_bits", -1),
        ("analogue_bits", 13),
        ("length_mm", 0.0),
        ("length_mm", np.nan),
    ],
)
def test_a_plate_that_cannot_be_is_refused(field: str, value: float) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be"):
        GrayPlate(**{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"line_sigma_mm": 0.1 * MITCHELSON.cell_mm}, "line_sigma_mm is"),
        ({"line_sigma_mm": 3.0 * MITCHELSON.cell_mm}, "line_sigma_mm is"),
        ({"margin": 0.5}, "margin is 0.5"),
        ({"min_signal": -1.0}, "min_signal is -1.0"),
    ],
)
def test_a_reading_without_meaning_is_refused(change: dict[str, float], match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        read_gray(MITCHELSON, np.ones((1, 11)), **{"line_sigma_mm": SIGMA, **change})


def test_outputs_of_another_plate_and_a_negative_width_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="the plate's 11 tracks"):
        read_gray(MITCHELSON, np.ones((4, 10)), line_sigma_mm=SIGMA)
    with pytest.raises(InvalidParameter, match="sigma_mm has -1"):
        MITCHELSON.outputs(np.array([1.0]), np.array([-1.0]))
