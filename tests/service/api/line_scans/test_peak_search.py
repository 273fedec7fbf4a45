"""What an answer says beside the peaks: lines that were split, saturated pixels, the guess."""

from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from numpy.typing import NDArray

from compute.optics.profiles.profile_loader import load_profile
from compute.planning.volume_scans import volume_scans
from service.api.line_scans.methods import FitMethod
from service.api.line_scans.noise import NoiseConstants, estimate_noise
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.schema import PixelNoise
from tests.service.api.line_scans.scan_lines import NOISE, WIDTH, body, scenes

PATH = "/api/v1/line-scans"
GAIN, READ, OFFSET = 10.0, 15.0, 100.0


def traced_line() -> tuple[NDArray[np.uint16], PixelNoise]:
    """The brightest traced line of the bar: one marker, no Gaussian, shape (1, P)."""
    profile = load_profile("bar")
    known = profile.detector
    lines = volume_scans(profile, 2)
    bright = lines.lines[[int(lines.lines.max(axis=1).argmax())]]
    noise = PixelNoise(
        electrons_per_count=known.electrons_per_count,
        read_noise_electrons=known.read_noise_electrons,
        offset_counts=known.offset_counts,
        full_scale_counts=lines.full_counts,
    )
    return bright, noise


def test_a_bright_line_of_another_shape_is_one_peak_unless_a_width_is_given() -> None:
    line, noise = traced_line()
    whole = find_peaks(line, FitMethod(), noise).scans[0]
    assert len(whole.peaks) == 1
    assert whole.further_peaks is None
    split = find_peaks(line, FitMethod(further_peaks=True), noise).scans[0]
    assert split.further_peaks == len(split.peaks) - 1 > 0


def test_a_given_width_takes_a_pair_apart(client: TestClient) -> None:
    found = client.post(PATH, json=body({"method": "fit", "width_px": WIDTH})).json()["scans"]
    assert [scan["further_peaks"] for scan in found] == [1, 0]
    assert ["joint" in peak["flags"] for peak in found[0]["peaks"]] == [False, True, True]
    found = client.post(PATH, json=body({"method": "fit"})).json()["scans"]
    assert [scan["further_peaks"] for scan in found] == [None, None]
    assert ["poor-fit" in peak["flags"] for peak in found[0]["peaks"]] == [False, True]


@pytest.mark.parametrize(
    "method",
    [
        {"method": "centroid"},
        {"method": "fit"},
        {"method": "matched"},
    ],
)
def test_a_saturated_line_says_so(client: TestClient, method: dict[str, Any]) -> None:
    full = NOISE.full_scale_counts
    lines = [[full] * 512, *scenes().tolist()]
    found = client.post(PATH, json=body(method, scans=lines)).json()["scans"]
    assert [scan["saturated_pixels"] for scan in found[:2]] == [512, 0]
    assert found[2]["saturated_pixels"] == (scenes()[1] == full).sum() > 0
    assert found[0]["peaks"] == []


def test_averaged_lines_count_a_pixel_that_is_saturated_in_any(client: TestClient) -> None:
    lines = np.full((2, 64), 200)
    lines[0, 10] = lines[1, 20] = lines[1, 10] = NOISE.full_scale_counts
    chain = {"method": "chain", "average": 2}
    found = client.post(PATH, json=body(chain, scans=lines.tolist())).json()
    assert found["scans"][0]["saturated_pixels"] == 2


def drawn(rng: np.random.Generator) -> NDArray[np.uint16]:
    """Level lines of 40 counts of light on the offset."""
    light = rng.poisson(GAIN * 40.0, (64, 2048)) + rng.normal(0.0, READ, (64, 2048))
    return np.rint(light / GAIN + OFFSET).astype(np.uint16)


def test_an_offset_mends_the_guessed_gain() -> None:
    lines = drawn(np.random.default_rng(2))
    blind, assumed = estimate_noise(lines)
    told, said = estimate_noise(lines, NoiseConstants(offset_counts=OFFSET))
    # Photon noise of 40 counts at 10 electrons, and the read noise, which is taken for it.
    variance = 40.0 / GAIN + (READ / GAIN) ** 2
    # The spread is measured from ranks, on 1.5 pixels of independent noise in each of 131072.
    assert told.electrons_per_count == pytest.approx(40.0 / variance, rel=0.1)
    assert blind.electrons_per_count == pytest.approx(140.0 / variance, rel=0.1)
    assert told.offset_counts == OFFSET
    for texts in (assumed, said):
        assert any("lower limits" in text for text in texts)
    assert any(text.startswith("offset: 0") for text in assumed)
    assert not any(text.startswith("offset") for text in said)


def test_no_lower_limit_is_promised_where_the_gain_is_the_least() -> None:
    lines = drawn(np.random.default_rng(3))
    noise, assumed = estimate_noise(lines, NoiseConstants(offset_counts=OFFSET + 38.0))
    assert noise.electrons_per_count == 1.0
    assert not any("lower limits" in text for text in assumed)


def test_the_offset_over_rest(client: TestClient) -> None:
    method: dict[str, Any] = {"method": "fit"}
    found = client.post(PATH, json=body(method, noise=None, offset_counts=OFFSET)).json()
    assert found["noise"]["offset_counts"] == OFFSET
    blind = client.post(PATH, json=body(method, noise=None)).json()
    gains = [one["noise"]["electrons_per_count"] for one in (found, blind)]
    assert gains[0] < gains[1]
    twice = client.post(PATH, json=body(method, offset_counts=OFFSET))
    assert twice.status_code == 422
    assert "beside noise" in twice.json()["detail"]
