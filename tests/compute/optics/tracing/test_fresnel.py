"""Fresnel's equations: energy, Brewster's angle, normal incidence, total reflection."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.window_refraction import transmittances

INDEX = st.floats(1.0, 4.0)


def reflectances(cosine, before, behind):
    """What does not pass is reflected."""
    return 1.0 - transmittances(cosine, before, behind)


@given(st.floats(0.0, 1.0), INDEX, INDEX)
def test_transmittances_lie_between_zero_and_one(cosine, before, behind):
    transmitted = transmittances(np.array([cosine]), before, behind)
    assert transmitted.shape == (1, 2)
    assert (transmitted >= 0.0).all()
    assert (transmitted <= 1.0 + 1e-12).all()


@given(INDEX, INDEX)
def test_light_in_the_plane_of_incidence_is_not_reflected_at_brewsters_angle(before, behind):
    cosine = np.cos(np.arctan2(behind, before))
    assert reflectances(cosine, before, behind)[..., 1] == pytest.approx(0.0, abs=1e-12)


@given(INDEX, INDEX)
def test_normal_incidence(before, behind):
    expected = ((before - behind) / (before + behind)) ** 2
    np.testing.assert_allclose(reflectances(1.0, before, behind), expected, rtol=0, atol=1e-14)


@given(INDEX, INDEX, st.floats(0.01, 1.0))
def test_s_and_p_by_the_sines_and_tangents_of_the_angles(before, behind, cosine):
    """Born & Wolf 1.5.2 (21): R_s = sin^2(i - t) / sin^2(i + t), R_p with tangents."""
    i = np.arccos(cosine)
    sine = before / behind * np.sin(i)
    if sine > 0.999 or abs(before - behind) < 1e-3 or i < 0.01:
        return
    t = np.arcsin(sine)
    expected = [(np.sin(i - t) / np.sin(i + t)) ** 2, (np.tan(i - t) / np.tan(i + t)) ** 2]
    np.testing.assert_allclose(reflectances(cosine, before, behind), expected, rtol=0, atol=1e-10)


def test_total_reflection():
    critical = np.sqrt(1.0 - 1.0 / 1.52**2)
    cosines = critical * np.array([0.0, 0.5, 1.0 - 1e-9])
    np.testing.assert_array_equal(reflectances(cosines, 1.52, 1.0), np.ones((3, 2)))
    np.testing.assert_array_equal(transmittances(cosines, 1.52, 1.0), np.zeros((3, 2)))
    assert (transmittances(critical * (1.0 + 1e-6), 1.52, 1.0) > 0.0).all()


def test_grazing_light_is_reflected_but_by_nothing():
    np.testing.assert_array_equal(reflectances(0.0, 1.0, 1.5), [1.0, 1.0])
    np.testing.assert_array_equal(reflectances(0.0, 1.5, 1.5), [0.0, 0.0])


@pytest.mark.parametrize("cosine", [-0.1, 1.1, np.nan])
def test_refuses_cosines_that_are_none(cosine):
    with pytest.raises(InvalidParameter, match="cos_incidence"):
        transmittances(np.array([0.5, cosine]), 1.0, 1.5)


@pytest.mark.parametrize(
    ("before", "behind", "name"), [(0.5, 1.5, "index_before"), (1.0, np.nan, "index_behind")]
)
def test_refuses_indices_that_are_none(before, behind, name):
    with pytest.raises(InvalidParameter, match=name):
        transmittances(0.5, before, behind)
