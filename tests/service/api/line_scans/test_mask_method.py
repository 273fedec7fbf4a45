"""Shadows of coded windows over REST: the readings are compute's, by template and by profile."""

import functools
import io
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import light_source, mask_optics, window_shadows
from compute.signal.coded_aperture.shadow_fit import MaskReader, ShadowSettings
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from service.api.line_scans.examples import NEW_LINE_SCANS
from service.api.line_scans.mask_method import MaskMethod, Template
from service.api.line_scans.noise import line_noise
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.plot import draw_scan
from service.api.line_scans.schema import LineScanRequest
from service.pipeline.detection_stage import built_in_profile
from tests.compute.signal.coded_aperture.coded_aperture_scenes import (
    PIXELS,
    shadows,
    window_optics,
    woven,
)
from tests.compute.signal.synthetic_scans import varied_lines
from tests.service.api.line_scans.scan_lines import NOISE, noisy

PATH = "/api/v1/line-scans"
SHIFTS_PX = (0.0, 40.3, -62.7)
BRIGHTEST = 200.0  # brighter shadows off the middle show that the template is of it


@functools.cache
def window_shadow() -> ShadowTemplate:
    return woven(window_optics(), 4)


def template() -> dict[str, Any]:
    """The template of the test's window as a client sends it."""
    shadow = window_shadow()
    return {
        "cells": (shadow.cells / shadow.cells.max()).tolist(),
        "per_px": shadow.per_px,
        "first_px": shadow.first_px,
        "reading_px": shadow.reading_px,
        "dark_beyond": shadow.dark_beyond,
    }


@functools.cache
def light_of_markers() -> np.ndarray:
    """Of three markers, without noise."""
    found, _ = shadows(window_optics(), SHIFTS_PX)
    return found


def lines(seed: int = 1) -> np.ndarray:
    """Shadows of three markers with noise, and a line without any."""
    counts = (
        np.vstack([light_of_markers() / light_of_markers().max(), np.zeros((1, PIXELS))])
        * BRIGHTEST
        + 30.0
    )
    return noisy(counts, seed)


def body(method: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {
        "scans": lines().tolist(),
        "method": {"method": "mask", **method},
        "noise": NOISE.model_dump(),
    } | changes


def post(client: Any, request: Any) -> Any:
    answer = client.post(PATH, json=request)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.slow
@pytest.mark.parametrize("fit_scale", [False, True])
def test_fitted_shadows_are_compute_s(sqlite_client: Any, fit_scale: bool) -> None:
    given_ = template()
    answer = post(sqlite_client, body({"template": given_, "fit_scale": fit_scale}, detail=True))
    ours = Template(**given_).shadow
    batch = MaskReader([ours], PIXELS, line_noise(NOISE), ShadowSettings(fit_scale=fit_scale)).read(
        lines()
    )
    assert batch.count.tolist() == [1, 1, 1, 0]
    for line, found in enumerate(answer["scans"][:3]):
        (peak,) = found["peaks"]
        for name in ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2"):
            assert peak[name] == float(getattr(batch, name)[line, 0])
        true = ours.reading_px + SHIFTS_PX[line]
        assert abs(peak["position_px"] - true) < 5.0 * peak["sigma_px"]
        assert peak["response_sigma"] > 10.0 * found["limit_sigma"]
        # Of the correlation, the highest value is at the reading.
        (stage,) = found["stages"]
        reading = int(np.argmax(stage["values"])) - stage["shift_px"]
        assert abs(reading - true) < 1.0
    assert answer["scans"][3]["peaks"] == answer["scans"][3]["windows"] == []


def test_the_model_is_the_pixels_but_for_the_noise(sqlite_client: Any) -> None:
    answer = post(sqlite_client, body({"template": template(), "fit_scale": True}, detail=True))
    for line, found in enumerate(answer["scans"][:3]):
        (window,) = found["windows"]
        assert window["values"] == lines()[line].tolist()
        rest = np.array(window["residual_sigma"])
        # The squares of what is left are those that the fit says.
        assert np.sum(rest**2) == pytest.approx(window["chi2"], rel=1e-3)
        assert window["chi2"] / window["dof"] == pytest.approx(1.0, abs=0.25)
        model = np.array(window["model"])
        assert np.abs(model - lines()[line]).max() < 8.0 * np.sqrt(model.max())


def test_the_thesis_s_correlation(sqlite_client: Any) -> None:
    given_ = template()
    answer = post(sqlite_client, body({"template": given_, "estimator": "correlation"}))
    ours = Template(**given_).shadow
    decoded = decode_mask(lines()[:3].astype(float), ours.pixel_values).shift_px
    for line, found in enumerate(answer["scans"][:3]):
        (peak,) = found["peaks"]
        expected = ours.reading_px + decoded[line] - ours.first_px
        assert peak["position_px"] == pytest.approx(expected, abs=1e-9)
        assert abs(peak["position_px"] - ours.reading_px - SHIFTS_PX[line]) < 0.2
        assert peak["sigma_px"] is None
    assert answer["scans"][3]["peaks"] == []


@pytest.mark.slow
def test_a_profile_s_shadows_sensor_by_sensor(sqlite_client: Any) -> None:
    profile = load_profile("coda-mpx30")
    optics = mask_optics(profile, light_source(profile))
    assert optics is not None
    point = np.array([[40.0, 25.0, 0.0]]) + profile.volume.centre_mm
    light = optics.solid_angles(point).solid_angle_sr[0]
    counts = np.rint(500.0 * light / light.max() + 120.0).astype(int)
    names = [sensor.name for sensor in profile.sensors]
    true = dict(zip(names, optics.readings(point)[0], strict=True))

    def read(sensors: list[str] | None, order: list[int]) -> list[float]:
        chosen = {"profile_id": "coda-mpx30", "sensors": sensors}
        request = body(chosen, scans=counts[order].tolist())
        return [scan["peaks"][0]["position_px"] for scan in post(sqlite_client, request)["scans"]]

    assert read(None, [0, 1, 2]) == pytest.approx(list(true.values()), abs=0.1)
    last = [names[2], names[0]]
    assert read(last, [2, 0]) == pytest.approx([true[name] for name in last], abs=0.1)
    # A line's picture is that of its own sensor, whichever lines there are.
    method = MaskMethod(profile_id="coda-mpx30")
    assert method.of_line(4, built_in_profile).sensors == [names[1]]
    by_name = MaskMethod(profile_id="coda-mpx30", sensors=last)
    assert by_name.of_line(3, built_in_profile).sensors == [names[0]]
    pictures = [
        sqlite_client.post(f"{PATH}.png?scan=1", json=body(chosen, scans=counts[order].tolist()))
        for chosen, order in (
            ({"profile_id": "coda-mpx30"}, [0, 1, 2]),
            ({"profile_id": "coda-mpx30", "sensors": [names[2], names[1]]}, [2, 1]),
        )
    ]
    assert pictures[0].status_code == 200
    assert pictures[0].content == pictures[1].content


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ({}, ["method has neither of template and profile"]),
        ({"template": {"cells": [0.0] * 4 + [1.0] * 4, "reading_px": 1.0}, "profile_id": "bar"},
         ["method has both of template and profile"]),
        ({"template": {"cells": [1.0] * 64, "reading_px": 1.0}}, ["must have contrast"]),
        ({"template": {"cells": [0.0] * 9, "per_px": 4, "reading_px": 1.0}}, ["8 pixels or more"]),
        ({"template": {"cells": [1.0] * 7, "reading_px": 1.0}}, ["cells", "at least 8 items"]),
        ({"template": {"cells": [1.0] * 8}}, ["reading_px", "required"]),
        ({"profile_id": "bar"}, ["2048"]),
        ({"profile_id": "coda-mpx30"}, ["1024 pixels", "2048"]),
        ({"profile_id": "coda-mpx30", "sensors": []}, ["sensors", "at least 1 item"]),
        ({"sensors": ["left"], "template": {"cells": [0.0] * 8, "reading_px": 1.0}},
         ["sensors are those of a profile"]),
        ({"profile_id": "coda-mpx30", "false_alarms_per_line": 0.0}, ["false_alarms_per_line"]),
    ],
)  # fmt: skip
def test_what_is_refused(sqlite_client: Any, method: dict[str, Any], words: list[str]) -> None:
    answer = sqlite_client.post(PATH, json=body(method))
    assert answer.status_code == 422, answer.text
    for word in words:
        assert word in answer.json()["detail"]


@pytest.mark.slow
def test_detail_has_no_more_correlations_than_memory(sqlite_client: Any) -> None:
    long = {"cells": [0.0, 1.0] * 20_000, "reading_px": 0.0}
    request = body({"template": long}, scans=[[100] * 64] * 7, detail=True)
    answer = sqlite_client.post(PATH, json=request)
    assert answer.status_code == 422
    assert "280448 values" in answer.json()["detail"]
    assert "262144" in answer.json()["detail"]
    post(sqlite_client, request | {"detail": False})
    post(sqlite_client, request | {"scans": request["scans"][:6]})


def test_profiles_that_are_of_no_use(sqlite_client: Any) -> None:
    wide = [[100] * 2048]
    for chosen, words in (
        ({"profile_id": "none"}, 'method.profile: there is no device profile "none"'),
        ({"profile_id": "bar"}, "bar has no coded windows"),
        ({"profile_id": "coda-mpx30", "sensors": ["nose"]}, 'no sensor "nose"; it has left'),
    ):
        for path in (PATH, f"{PATH}.png"):
            answer = sqlite_client.post(path, json=body(chosen, scans=wide))
            assert answer.status_code == 422
            assert words in answer.json()["detail"]


@pytest.mark.slow
def test_pictures(sqlite_client: Any) -> None:
    """One of the fit and one of the correlation; also where the reading is off the line."""
    pictures = [
        sqlite_client.post(
            f"{PATH}.png?scan={line}", json=body({"template": template(), "estimator": how})
        )
        for how in ("fit", "correlation")
        for line in (1, 3)
    ]
    assert {answer.status_code for answer in pictures} == {200}
    assert len({answer.content for answer in pictures}) == 3  # without a shadow both are one
    line = lines()[:1]
    off = MaskMethod(template=Template(**template() | {"reading_px": -700.0}))
    found = find_peaks(line, off, NOISE, detail=True)
    assert found.scans[0].peaks[0].position_px < -600.0
    png = draw_scan(line[0], found, off, "line 0")
    assert Image.open(io.BytesIO(png)).format == "PNG"


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.sampled_from([64, 300]), st.sampled_from(["fit", "scale"]))
@settings(max_examples=25, deadline=None)
def test_any_line_gives_an_answer(seed: int, pixels: int, how: str) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, 2, 40).repeat(4).astype(float)
    cells[0] = 1.0 - cells[-1]  # there is some contrast
    shadow = Template(cells.tolist(), reading_px=20.0, per_px=2, dark_beyond=bool(seed % 2))
    some = varied_lines(8, pixels, rng)
    for estimator in ("fit", "correlation"):
        method = MaskMethod(estimator=estimator, template=shadow, fit_scale=how == "scale")
        found = find_peaks(some, method, detail=True)
        json.dumps(found.model_dump(), allow_nan=False)
        plain = find_peaks(some, method).scans
        assert plain == [
            scan.model_copy(update={"windows": None, "stages": None}) for scan in found.scans
        ]
        for scan in found.scans:
            assert all(peak.sigma_px is None or peak.sigma_px > 0.0 for peak in scan.peaks)


def test_the_example_finds_its_shadow() -> None:
    request = LineScanRequest.model_validate(NEW_LINE_SCANS["mask"]["value"])
    found = find_peaks(np.array(request.scans, np.uint16), request.method, request.noise)
    (peak,) = found.scans[0].peaks
    assert peak.sigma_px is not None
    assert abs(peak.position_px - 61.8) < 4.0 * peak.sigma_px
    assert peak.flags == ()


def test_a_profile_without_windows_has_no_shadows() -> None:
    assert window_shadows(load_profile("bar")) == ()
    assert window_shadows(load_profile("mitchelson-1971")) == ()
