"""LEDs and retro-reflectors: energy, distances, angles, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.light.emission import CosinePower
from compute.optics.light.led import Led
from compute.optics.light.light_source import LightSource
from compute.optics.light.retroreflector import Illuminator, RetroDisc, RetroSheet
from validation.signal_chain.retro_sphere import RetroSphere

LENS = np.array([[0.0, 0.0, 0.0]])
FAR = np.array([[0.0, 0.0, 2000.0]])
TOWARDS = np.array([[0.0, 0.0, -1.0]])
LED = Led(0.020, 950.0, CosinePower(np.deg2rad(18.0)), 55.0, 0.4)
LAMP = Illuminator((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 2.0, CosinePower(np.deg2rad(18.0)), 950.0)
SHEET = RetroSheet(500.0, np.deg2rad(0.5), np.deg2rad(40.0))
DISC = RetroDisc(10.0, SHEET, LAMP)
SPHERE = RetroSphere(10.0, SHEET, LAMP)
PHOTON_J = 6.62607015e-34 * 299_792_458.0 / 950e-9


def turned(angle_rad: float) -> np.ndarray:
    return np.array([[np.sin(angle_rad), 0.0, -np.cos(angle_rad)]])


def one(source: LightSource, facing: np.ndarray | None = None, at: np.ndarray = FAR) -> float:
    return float(source.photons_per_sr(at, facing, LENS, 1e-3)[0, 0])


def test_an_led_sends_its_energy_over_that_of_a_photon() -> None:
    assert one(LED) == pytest.approx(0.020 * 1e-3 / PHOTON_J, rel=1e-12)
    assert one(replace(LED, current_ratio=3.0)) == pytest.approx(3.0 * one(LED))


def test_all_directions_together_have_the_radiant_power() -> None:
    solid_angle_sr = 2.0 * np.pi / (CosinePower(1.0).exponent + 1.0)
    led = Led(0.010 / solid_angle_sr, 950.0, CosinePower(1.0))
    node, weight = np.polynomial.legendre.leggauss(200)
    cosine = 0.5 * (node + 1.0)
    facing = np.stack([np.sqrt(1.0 - cosine**2), 0.0 * cosine, -cosine], axis=1)
    light = led.photons_per_sr(np.repeat(FAR, 200, axis=0), facing, LENS, 2.0)[:, 0]
    assert (np.pi * weight * light).sum() * PHOTON_J == pytest.approx(0.020, rel=1e-6)


@given(st.floats(1.0, 1e5), st.floats(0.0, np.pi))
def test_an_led_is_as_bright_per_steradian_at_every_distance(
    distance_mm: float, angle_rad: float
) -> None:
    at = np.array([[0.0, 0.0, distance_mm]])
    assert one(LED, turned(angle_rad), at) == pytest.approx(one(LED, turned(angle_rad)), rel=1e-6)


def test_an_led_is_dark_behind_and_half_as_bright_at_its_half_angle() -> None:
    assert one(LED, turned(np.deg2rad(18.0))) == pytest.approx(0.5 * one(LED))
    assert one(LED, 7.0 * TOWARDS) == pytest.approx(one(LED))
    for angle_rad in (np.pi / 2 + 1e-6, 2.0, np.pi):
        assert one(LED, turned(angle_rad)) == 0.0


def test_a_pulse_lights_a_part_of_the_exposure_and_no_more() -> None:
    assert one(replace(LED, pulse_s=2e-4)) == pytest.approx(0.2 * one(LED))
    assert one(replace(LED, pulse_s=5.0)) == pytest.approx(one(LED))


@pytest.mark.parametrize("source", [LED, DISC, SPHERE])
def test_each_marker_and_lens_has_its_own_light(source: LightSource) -> None:
    points = np.array([[0.0, 0.0, 2000.0], [100.0, 50.0, 1500.0], [-300.0, 20.0, 1800.0]])
    lenses = np.array([[0.0, 0.0, 0.0], [12.0, 0.0, 0.0]])
    facing = np.array([[0.0, 0.1, -1.0], [-0.3, 0.0, -2.0], [0.5, 0.0, -1.0]])
    for directions in (None, facing):
        light = source.photons_per_sr(points, directions, lenses, 1e-3)
        assert light.shape == (3, 2)
        for n in range(3):
            for s in range(2):
                alone = source.photons_per_sr(
                    points[[n]], None if directions is None else facing[[n]], lenses[[s]], 1e-3
                )
                assert light[n, s] == pytest.approx(float(alone[0, 0]), rel=1e-12)
    assert source.photons_per_sr(points[:0], None, lenses, 1.0).shape == (0, 2)
    assert source.wavelength_nm == 950.0


def test_a_disc_before_the_lamp_by_hand() -> None:
    """2 W/sr at 2 m are 0.5 W/m^2; times 500/sr times pi/4 (10 mm)^2: 19.6 mW/sr."""
    intensity = 0.5 * 500.0 * np.pi / 4.0 * 1e-4
    assert one(DISC) == pytest.approx(intensity * 1e-3 / PHOTON_J, rel=1e-9)


@given(st.floats(10.0, 1e5))
def test_a_retroreflector_falls_with_the_square_of_the_lamps_distance(distance_mm: float) -> None:
    at = np.array([[0.0, 0.0, distance_mm]])
    for source in (DISC, SPHERE):
        assert one(source, None, at) == pytest.approx(
            one(source) * (2000.0 / distance_mm) ** 2, rel=1e-9
        )


def test_half_is_left_at_each_half_angle() -> None:
    half = np.deg2rad(0.5)
    beside = 2000.0 * np.array([[np.sin(half), 0.0, 1.0 - np.cos(half)]])
    for source in (DISC, SPHERE):
        light = source.photons_per_sr(FAR, TOWARDS, beside, 1e-3)[0, 0]
        assert light == pytest.approx(0.5 * one(source, TOWARDS), rel=1e-9)
    entrance = one(DISC, turned(np.deg2rad(40.0)))
    assert entrance == pytest.approx(0.5 * np.cos(np.deg2rad(40.0)) * one(DISC), rel=1e-9)
    assert one(DISC, turned(2.0)) == 0.0
    assert one(SPHERE, turned(2.0)) == one(SPHERE)
    # In the beam, at its half angle.
    off = 2000.0 * np.array([[np.sin(np.deg2rad(18.0)), 0.0, np.cos(np.deg2rad(18.0))]])
    assert one(DISC, None, off) == pytest.approx(0.5 * one(DISC), rel=1e-6)
    assert one(DISC, None, -FAR) == 0.0


def test_a_disc_is_dark_to_a_lens_behind_its_plane() -> None:
    """Lit at a grazing angle from beside the lens, which sees its back, or the other way round."""
    wide = replace(SHEET, observation_half_angle_rad=1.0, entrance_half_angle_rad=10.0)
    lamp = replace(LAMP, position_mm=(200.0, 0.0, 0.0), emission=CosinePower(1.0))
    disc = RetroDisc(10.0, wide, lamp)
    both, lit_alone, neither = (turned(np.pi / 2 + offset) for offset in (-0.05, 0.05, 0.2))
    assert one(disc) > 0.0
    assert one(disc, both) > 0.0
    assert one(disc, lit_alone) == 0.0  # the lamp is 0.1 rad to the lens's side
    assert one(disc, neither) == 0.0
    assert one(disc, turned(-np.pi / 2 + 0.05)) == 0.0  # seen, but lit from behind


def test_a_sphere_is_a_disc_of_its_projected_area_where_every_entrance_angle_does() -> None:
    projected = np.pi / 4.0 * 1e-4
    even = replace(SPHERE, sheet=replace(SHEET, entrance_half_angle_rad=1e6))
    assert even.effective_area_m2 == pytest.approx(projected, rel=1e-9)
    assert 0.4 * projected < SPHERE.effective_area_m2 < 0.8 * projected
    # By patches of its surface, each a small disc.
    edges = np.linspace(0.0, np.pi / 2, 4001)
    entrance = 0.5 * (edges[1:] + edges[:-1])
    patches = 2.0 * np.pi * 0.005**2 * -np.diff(np.cos(edges))
    facing = np.stack([np.sin(entrance), 0.0 * entrance, -np.cos(entrance)], axis=1)
    light = DISC.photons_per_sr(np.repeat(FAR, 4000, axis=0), facing, LENS, 1e-3)[:, 0]
    assert one(SPHERE) == pytest.approx((light * patches).sum() / projected, rel=1e-6)


@pytest.mark.parametrize(
    ("holder", "field", "value"),
    [
        (LED, "radiant_intensity_w_per_sr", 0.0),
        (LED, "wavelength_nm", -1.0),
        (LED, "spectral_width_nm", -1.0),
        (LED, "emitter_width_mm", np.nan),
        (LED, "current_ratio", -0.5),
        (LED, "pulse_s", 0.0),
        (LAMP, "radiant_intensity_w_per_sr", np.inf),
        (LAMP, "direction", (0.0, 0.0, 0.0)),
        (SHEET, "coefficient_per_sr", 0.0),
        (SHEET, "observation_half_angle_rad", -0.1),
        (SHEET, "entrance_half_angle_rad", 0.0),
        (DISC, "diameter_mm", 0.0),
        (SPHERE, "diameter_mm", -3.0),
    ],
)
def test_values_without_meaning_are_refused(holder: Led, field: str, value: float) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is") as refused:
        replace(holder, **{field: value})
    assert field in refused.value.context


@pytest.mark.parametrize("source", [LED, DISC, SPHERE])
def test_arrays_that_do_not_fit_are_refused(source: LightSource) -> None:
    for points, facing, lenses, exposure_s, field in (
        (FAR[0], None, LENS, 1.0, "points_mm"),
        (FAR, None, LENS[:, :2], 1.0, "lens_positions_mm"),
        (FAR, np.zeros((2, 3)), LENS, 1.0, "facing"),
        (FAR, np.zeros((1, 3)), LENS, 1.0, "facing"),
        (FAR, None, LENS, -1.0, "exposure_s"),
    ):
        with pytest.raises(InvalidParameter, match=field):
            source.photons_per_sr(points, facing, lenses, exposure_s)
