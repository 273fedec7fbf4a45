"""Coded windows before sensors: geometry, light, and the size of the fringes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.sensor_placement import place_sensor
from tests.compute.optics.coded_aperture.mask_sensors import sensor_behind

GAP = 10.0
PITCH = 0.01
HEIGHT = 0.2
CODED = CodedWindow(maximal_length_code(6), 0.15, GAP, 3.0, 1.5)
LED = {"emitter_width_mm": 0.5, "wavelength_nm": 900.0, "spectral_width_nm": 50.0}


def optics(window: CodedWindow = CODED, **light: float) -> MaskOptics:
    return MaskOptics(window, [sensor_behind(window.gap_mm)], pixel_height_mm=HEIGHT, **light)


def line(made: MaskOptics, *point: float) -> np.ndarray:
    return made.solid_angles(np.array([point])).solid_angle_sr[0, 0]


DIFFRACTED, PLAIN = optics(**LED), optics(emitter_width_mm=0.5)
REFERENCE = np.array([[0.0, 0.0, 2000.0]])


@pytest.mark.parametrize("made", [DIFFRACTED, PLAIN], ids=["diffracted", "geometric"])
@settings(max_examples=40, deadline=None)
@given(x=st.floats(-700.0, 700.0), y=st.floats(-600.0, 600.0), z=st.floats(1900.0, 2100.0))
def test_the_decoded_shift_is_that_of_the_rays(
    made: MaskOptics, x: float, y: float, z: float
) -> None:
    template = made.solid_angles(REFERENCE).solid_angle_sr[0, 0]
    points = np.array([[x, y, z]])
    shift = decode_mask(made.solid_angles(points).solid_angle_sr[0, 0], template)
    expected = (made.readings(points) - made.readings(REFERENCE))[0, 0]
    # Obliquity tilts the brightness and stretches the shadow, which plain correlation ignores.
    assert float(shift.shift_px) == pytest.approx(expected, abs=0.25)
    assert float(shift.second_ratio) < 0.5


@settings(deadline=None)
@given(x=st.floats(-900.0, 900.0), y=st.floats(-900.0, 900.0), z=st.floats(100.0, 3000.0))
def test_without_a_plate_the_reading_is_the_camera_models(x: float, y: float, z: float) -> None:
    sensor = place_sensor(
        "one",
        lens_position_mm=(30.0, -20.0, 10.0),
        aim_mm=(100.0, 200.0, 1500.0),
        measured_direction=(1.0, 0.5, 0.0),
        principal_distance_mm=GAP,
        pixels=2048,
        pitch_um=10.0,
    )
    made = MaskOptics(CodedWindow((1,), 0.1, GAP), [sensor], pixel_height_mm=HEIGHT)
    points = np.array([[x, y, z]])
    expected = CameraStack.of([sensor.model]).project(points)
    np.testing.assert_allclose(made.readings(points), expected, atol=1e-7)


def test_one_slit_throws_its_light_where_the_reading_says() -> None:
    made = optics(CodedWindow((1,), 0.1, GAP, 3.0, 1.5), **LED)
    for x, y in ((0.0, 0.0), (400.0, 300.0), (-700.0, 200.0)):
        light = line(made, x, y, 1500.0)
        centroid = light @ np.arange(light.size) / light.sum()
        reading = made.readings(np.array([[x, y, 1500.0]]))[0, 0]
        assert reading == pytest.approx(1023.5 + GAP / PITCH * x / 1500.0, abs=1.0)
        # Faint light far beside a slit at an angle is brighter on the near side.
        assert centroid == pytest.approx(reading, abs=0.5)


def test_readings_grow_along_the_objects_x_and_the_first_bar_reads_lowest() -> None:
    window = CodedWindow((1, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0), 0.3, GAP)
    made = optics(window)
    light = line(made, 0.0, 0.0, 2000.0)
    lit = np.flatnonzero(light > 1e-6 * light.max())
    # First bar, then five opaque ones, in readings; two opaque bars end the code unseen.
    assert np.diff(lit).max() == pytest.approx(5 * 0.3 / PITCH, abs=3)
    assert np.diff(lit).argmax() < lit.size / 2
    assert (
        np.diff(made.readings(np.array([[-9.0, 0, 2e3], [0, 0, 2e3], [9.0, 0, 2e3]])), axis=0) > 0
    ).all()


def test_an_open_window_passes_the_solid_angle_of_the_pixels() -> None:
    made = optics(CodedWindow((1,) * 300, 0.2, GAP))
    light = line(made, 120.0, 300.0, 1500.0)
    x = -(np.arange(2048) - 1023.5) * PITCH
    squared = (x - 120.0) ** 2 + 300.0**2 + (1500.0 + GAP) ** 2
    np.testing.assert_allclose(light, PITCH * HEIGHT * (1500.0 + GAP) / squared**1.5, rtol=1e-6)


def test_glass_takes_what_fresnel_says() -> None:
    bare = line(optics(CodedWindow((1,) * 300, 0.2, GAP)), 0.0, 0.0, 3000.0)[1023]
    glass = line(optics(CodedWindow((1,) * 300, 0.2, GAP, 1e-6, 1.52)), 0.0, 0.0, 3000.0)[1023]
    assert glass / bare == pytest.approx((1.0 - (0.52 / 2.52) ** 2) ** 2, rel=1e-5)


def test_the_size_of_the_fringes() -> None:
    """Prints, per width of the bars, how far the shadow is from the geometric one."""
    rms = []
    for order, bar in ((8, 0.06), (6, 0.15), (5, 0.3), (3, 1.0)):
        window = CodedWindow(maximal_length_code(order), bar, GAP, 3.0, 1.5)
        full = PITCH * HEIGHT / (2000.0 + GAP - 3.0 + 2.0) ** 2
        with_fringes = line(optics(window, **LED), 0.0, 0.0, 2000.0) / full
        without = line(optics(window, emitter_width_mm=0.5), 0.0, 0.0, 2000.0) / full
        lit = abs(np.arange(2048) - 1023.5) * PITCH < window.length_mm / 2
        rms.append(float(np.sqrt(((with_fringes - without)[lit] ** 2).mean())))
        print(f"bars of {1e3 * bar:4.0f} um: fringes {rms[-1]:.3f} RMS of the full light, ", end="")
        print(f"peak {with_fringes.max():.2f}")
    assert rms[0] > 0.3
    assert (np.diff(rms) < 0.0).all()
    assert rms[-1] > 0.05


def test_fringes_move_light_and_do_not_make_any() -> None:
    point = (150.0, 50.0, 2000.0)
    assert line(DIFFRACTED, *point).sum() == pytest.approx(line(PLAIN, *point).sum(), rel=3e-3)


def test_bars_finer_than_a_pixel_fade() -> None:
    def contrast(bar_mm: float) -> float:
        made = optics(CodedWindow((1, 0) * 40, bar_mm, GAP))
        light = line(made, 0.0, 0.0, 2000.0)
        inner = light[abs(np.arange(2048) - 1023.5) * PITCH < 20 * bar_mm]
        return float(np.ptp(inner) / (inner.max() + inner.min()))

    assert contrast(4.3 * PITCH) > 0.99
    assert contrast(0.43 * PITCH) < 0.3


def test_a_wide_emitter_softens_the_edges() -> None:
    window = CodedWindow((1,), 2.0, GAP)
    sharp = line(optics(window), 0.0, 0.0, 500.0)
    soft = line(optics(window, emitter_width_mm=20.0), 0.0, 0.0, 500.0)
    partly = [int(((e > 0.01 * e.max()) & (e < 0.99 * e.max())).sum()) for e in (sharp, soft)]
    # 20 mm at 510 mm seen through a slit 10 mm before the pixels: 0.4 mm, 40 pixels an edge.
    assert partly[0] <= 2
    assert 70 <= partly[1] <= 82
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-3)


def test_the_ends_of_the_bars_cut_the_light() -> None:
    low = CodedWindow((1,) * 300, 0.2, GAP, height_mm=1.0)
    open_ = optics(CodedWindow((1,) * 300, 0.2, GAP))
    # A point at y is seen by the pixels through y x gap / (z + gap) on the mask.
    edge = 0.5 * (1500.0 + GAP) / GAP
    for y, part in ((0.0, 1.0), (edge, 0.5), (1.5 * edge, 0.0)):
        cut, whole = line(optics(low), 0.0, y, 1500.0), line(open_, 0.0, y, 1500.0)
        assert cut[1023] / whole[1023] == pytest.approx(part, abs=1e-9)


@pytest.mark.parametrize(
    "point",
    [(0.0, 0.0, -500.0), (0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (np.nan, 0.0, 1e3), (0.0, np.inf, 1e3)],
)
def test_no_light_from_behind_or_from_nowhere(point: tuple[float, float, float]) -> None:
    points = np.array([point, (0.0, 0.0, 2000.0)])
    light = DIFFRACTED.solid_angles(points).solid_angle_sr
    assert not light[0].any()
    assert light[1].any()
    assert np.isnan(DIFFRACTED.readings(points)[:, 0]).tolist() == [True, False]


def test_the_shadow_of_a_point_far_aside_misses_the_line() -> None:
    assert not line(DIFFRACTED, 6000.0, 0.0, 2000.0).any()
    assert not line(PLAIN, 6000.0, 0.0, 2000.0).any()


def test_sensors_and_points_come_in_their_order() -> None:
    sensors = [sensor_behind(GAP), sensor_behind(GAP, pixels=512)]
    made = MaskOptics(CODED, sensors, pixel_height_mm=HEIGHT, **LED)
    points = np.random.default_rng(3).uniform((-300, -300, 1000), (300, 300, 3000), (70, 3))
    got = made.solid_angles(points)
    assert got.solid_angle_sr.shape == (70, 2, 2048)
    assert got.first_px.dtype == np.int64
    assert not got.first_px.any()
    assert not got.solid_angle_sr[:, 1, 512:].any()
    single = MaskOptics(CODED, sensors[1:], pixel_height_mm=HEIGHT, **LED)
    for number in (0, 37, 69):
        alone = single.solid_angles(points[number : number + 1]).solid_angle_sr[0, 0]
        np.testing.assert_array_equal(got.solid_angle_sr[number, 1, :512], alone)
    assert made.solid_angles(np.zeros((0, 3))).solid_angle_sr.shape == (0, 2, 2048)


@pytest.mark.parametrize(
    ("field", "value"),
    [("pixel_height_mm", 0.0), ("pixel_height_mm", np.nan), ("emitter_width_mm", -1.0)],
)
def test_sizes_without_meaning_are_refused(field: str, value: float) -> None:
    good = {"pixel_height_mm": 0.2, "emitter_width_mm": 0.1}
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be"):
        MaskOptics(CODED, [sensor_behind(GAP)], **{**good, field: value})


def test_a_sensor_at_another_distance_than_the_gap_is_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"principal distance 12 mm; .* its gap, 10"):
        MaskOptics(CODED, [sensor_behind(12.0)], pixel_height_mm=HEIGHT)
