"""Lines posted over REST: the answer is compute's, and what is refused."""

import json
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.flags import flag_names
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.detection.matched_filter import gaussian_filter
from compute.signal.detection.peak_detector import DetectionSettings, PeakDetector
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise
from service.api.line_scans import router
from service.api.line_scans.chain_steps import ChainMethod, passive_chain
from service.api.line_scans.methods import CentroidMethod, FitMethod, MatchedMethod, Method
from service.api.line_scans.noise import line_noise
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.schema import MAX_SCANS
from tests.compute.signal.synthetic_scans import FULL, varied_lines
from tests.service.api.line_scans.scan_lines import NOISE, PLACES, WIDTH, body, scenes

PATH = "/api/v1/line-scans"
MODEL: SensorNoise = line_noise(NOISE)
FIT = {"method": "fit", "width_px": WIDTH}


def post(client: Any, request: Any, path: str = PATH) -> Any:
    answer = client.post(path, json=request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def check_peaks(found: dict[str, Any], batch: PeakBatch, line: int) -> None:
    """The peaks of an answer are these, bit by bit."""
    assert len(found["peaks"]) == batch.count[line]
    for k, peak in enumerate(found["peaks"]):
        for name in ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2"):
            value = float(getattr(batch, name)[line, k])
            assert peak[name] == (value if np.isfinite(value) else None)
        assert tuple(peak["flags"]) == flag_names(PeakFlag(int(batch.flags[line, k])))
        assert peak["response_sigma"] is None


def test_fitted_peaks_are_compute_s(sqlite_client: Any) -> None:
    answer = post(sqlite_client, body(FIT, detail=True))
    batch = fit_scans(scenes(), FitSettings(width_px=WIDTH), MODEL)
    assert batch.count.tolist() == [3, 2]
    for line, found in enumerate(answer["scans"]):
        check_peaks(found, batch, line)
        for place, peak in zip(PLACES[line], found["peaks"], strict=True):
            assert abs(peak["position_px"] - place) < 5.0 * peak["sigma_px"]
    first, second = answer["scans"]
    assert np.array_equal(first["covariance_px2"], batch.covariance(0))
    assert first["covariance_px2"][1][2] != 0.0
    assert second["covariance_px2"] is None
    assert second["peaks"][1]["flags"] == ["saturated"]
    turned = post(sqlite_client, body(FIT, scans=scenes()[::-1].tolist()))["scans"]
    assert turned[0]["covariance_px2"] is None
    assert np.allclose(turned[1]["covariance_px2"], first["covariance_px2"], rtol=1e-6, atol=0.0)


def test_windows_tell_model_and_residuals(sqlite_client: Any) -> None:
    [first, second] = post(sqlite_client, body(FIT, detail=True))["scans"]
    assert [len(window["position_px"]) for window in first["windows"]] == [1, 2]
    for scan, line in ((first, 0), (second, 1)):
        for window in scan["windows"]:
            values, model = np.array(window["values"]), np.array(window["model"])
            start = window["first_px"]
            assert values.tolist() == scenes()[line, start : start + len(values)].tolist()
            light = np.maximum(model - NOISE.offset_counts, 0.0)
            sigma = np.sqrt(MODEL.dark_variance[0] + MODEL.photon_variance[0] * light)
            residual = np.array(window["residual_sigma"])
            assert residual == pytest.approx((values - model) / sigma, rel=1e-9, abs=1e-9)
            used = np.array(window["used"])
            assert (values[~used] == FULL).all()
            # The width's prior is one more observation; and chi-square is that of the best
            # width, where the model is that of the mean one, a part of its deviation away.
            assert -0.2 < window["chi2"] - (residual[used] ** 2).sum() < 1.0
            assert len(window["covariance"]) == len(window["parameters"])
    assert not all(second["windows"][1]["used"])


def test_centres_of_gravity_are_compute_s(sqlite_client: Any) -> None:
    method = {"method": "centroid", "detection_sigma": 8.0, "weighting": "above-threshold"}
    answer = post(sqlite_client, body(method, detail=True))
    ours = CentroidSettings(detection_sigma=8.0, weighting="above-threshold")
    batch = find_peaks_reference(scenes(), ours, MODEL)
    for line, found in enumerate(answer["scans"]):
        check_peaks(found, batch, line)
        assert found["windows"] is found["stages"] is found["covariance_px2"] is None


def test_the_chain_is_compute_s_step_by_step(sqlite_client: Any) -> None:
    chain = passive_chain()
    given = {
        "method": "chain",
        "line_filter": {"kind": "butterworth", "order": 4, "cutoff": 0.4},
        "background": {
            "kind": "bridged",
            "mask": {"degree": 7},
            "smoothing": {"kind": "butterworth", "order": 4, "cutoff": 0.4},
        },
        "separation": {"kind": "slope-extension", "level_fraction": 0.2, "min_depth": 0.05},
        "threshold_fraction": 0.0,
        "min_width_px": 3,
    }
    answer = post(sqlite_client, body(given, detail=True))
    result = chain.run(scenes(), MODEL)
    for line, found in enumerate(answer["scans"]):
        check_peaks(found, result.peaks, line)
        names = [stage["name"] for stage in found["stages"]]
        assert names == ["raw", "filtered", "background", "subtracted"]
        for stage, ours in zip(found["stages"], result.stages, strict=True):
            # One line at a time rounds differently from all at once.
            assert stage["values"] == pytest.approx(ours.scans[line], rel=1e-12, abs=1e-9)


def test_detections_are_compute_s(sqlite_client: Any) -> None:
    method = {"method": "matched", "width_px": WIDTH, "false_alarms_per_line": 0.05}
    answer = post(sqlite_client, body(method, detail=True))
    detector = PeakDetector(
        gaussian_filter(WIDTH), 512, DetectionSettings(false_alarms_per_line=0.05), MODEL
    )
    batch = detector.detect(scenes())
    for line, found in enumerate(answer["scans"]):
        count = batch.count[line]
        assert [p["position_px"] for p in found["peaks"]] == batch.position_px[
            line, :count
        ].tolist()
        [stage] = found["stages"]
        assert stage["unit"] == "deviations"
        for peak in found["peaks"]:
            there = stage["values"][int(peak["position_px"])]
            assert peak["response_sigma"] == pytest.approx(there, rel=1e-6)
            assert there > found["limit_sigma"] == detector.threshold_sigma
            assert peak["sigma_px"] is None


def test_lines_are_averaged(sqlite_client: Any) -> None:
    method = {"method": "chain", "average": 2, "background": {"kind": "polynomial", "degree": 1}}
    lines = np.concatenate([scenes(seed)[:1] for seed in range(4)])
    answer = post(sqlite_client, body(method, scans=lines.tolist()))
    assert [found["index"] for found in answer["scans"]] == [0, 2]
    one = post(sqlite_client, body(method | {"average": 1}, scans=lines.tolist()))
    ratio = one["scans"][0]["peaks"][0]["sigma_px"] / answer["scans"][0]["peaks"][0]["sigma_px"]
    assert ratio == pytest.approx(2.0**0.5, rel=0.1)
    three = sqlite_client.post(PATH, json=body(method, scans=lines[:3].tolist()))
    assert three.status_code == 422
    assert "multiple" in three.json()["detail"]


def test_what_is_guessed_is_said_and_can_be_sent_back(sqlite_client: Any) -> None:
    guessed = post(sqlite_client, body(FIT, noise=None))
    assert len(guessed["assumed"]) == 6
    assert guessed["noise"]["full_scale_counts"] == FULL
    given = post(sqlite_client, body(FIT, noise=guessed["noise"]))
    assert given["assumed"] == []
    assert given["scans"] == guessed["scans"]


def long(pixels: int, lines: int = 1) -> list[list[int]]:
    return [[100] * pixels] * lines


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scans": []}, ["body.scans", "at least 1 item"]),
        ({"scans": long(63)}, ["body.scans.0", "at least 64 items"]),
        ({"scans": long(65537)}, ["body.scans.0", "at most 65536 items"]),
        ({"scans": long(64, MAX_SCANS + 1)}, ["body.scans", "at most 256 items"]),
        ({"scans": [[1] * 64, [1] * 65]}, ["scans.1 has 65", "scans.0 has 64"]),
        ({"scans": [[1] * 64, [1] * 20 + [1.5] + [1] * 43]}, ["body.scans.1.20", "1.5"]),
        ({"scans": [[1] * 63 + [-1]]}, ["body.scans.0.63", "-1"]),
        ({"scans": [[1] * 63 + [65536]]}, ["body.scans.0.63", "65536"]),
        ({"scans": [[1] * 63 + ["1"]]}, ["body.scans.0.63", '"1"']),
        ({"scans": [[1] * 63 + [True]]}, ["body.scans.0.63", "true"]),
        ({"scans": [[1] * 70, [1] * 5 + [4096] + [1] * 64]}, ["scans.1.5 is 4096", "4095"]),
        ({"scans": long(65536, 9)}, ["589824 values", "524288"]),
        ({"scans": long(65536, 2), "detail": True}, ["131072 values", "65536"]),
        ({"scans": long(8193), "method": {"method": "chain"}}, ["8193 values", "8192"]),
        ({"scans": long(8192, 9), "method": {"method": "chain"}}, ["73728 values", "65536"]),
        ({"method": {"method": "chain", "repeats": 6}}, ["body.method", "repeats", "5"]),
        ({"method": {"method": "best"}}, ["body.method", "best"]),
        ({"method": {"width_px": 1.0}}, ["body.method"]),
        ({"method": {"method": "fit", "width_px": 17.0}}, ["body.method.width_px", "16"]),
        ({"method": {"method": "fit", "colour": 1}}, ["body.method.colour"]),
        ({"method": {"method": "fit", "search": {"max_peaks": 0}}}, ["method.search.max_peaks"]),
        ({"method": {"method": "fit", "width_log_sigma": 1e-9}}, ["width_log_sigma is 1e-09"]),
        ({"method": {"method": "matched", "width_px": 90.0}}, ["512 pixels", "1441"]),
        ({"method": {"method": "matched", "length_px": 16}}, ["length_px is 16", "odd"]),
        ({"noise": {"electrons_per_count": 0.0, "read_noise_electrons": 1.0}}, ["body.noise"]),
        ({"noise": {"electrons_per_count": 1.0}}, ["read_noise_electrons", "required"]),
    ],
)
def test_what_is_refused(sqlite_client: Any, changes: dict[str, Any], words: list[str]) -> None:
    answer = sqlite_client.post(PATH, json=body(FIT) | changes)
    problem = answer.json()
    assert answer.status_code == problem["status"] == 422
    for word in words:
        assert word in problem["detail"]


def test_one_wrong_value_of_many_is_reported_once(sqlite_client: Any) -> None:
    answer = sqlite_client.post(PATH, json=body(FIT, scans=[[-1] * 20_000] * 10))
    assert answer.status_code == 422
    assert len(answer.json()["errors"]) == 1


def test_other_requests_are_answered_meanwhile_and_too_many_refused(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = [Event(), Event()], Event()

    def slow(*given: Any, **named: Any) -> Any:
        for one in begun:
            if not one.is_set():
                one.set()
                break
        assert go_on.wait(240.0)
        return find_peaks(*given, **named)

    monkeypatch.setattr(router, "find_peaks", slow)
    with ThreadPoolExecutor(2) as pool:
        working = []
        for one in begun:
            working.append(pool.submit(sqlite_client.post, PATH, json=body(FIT)))
            assert one.wait(240.0)
        assert sqlite_client.get("/healthz").status_code == 200
        refused = sqlite_client.post(PATH, json=body(FIT))
        assert refused.status_code == 503
        assert refused.json()["type"] == "/problems/busy"
        assert int(refused.headers["retry-after"]) > 0
        go_on.set()
        assert [one.result(30.0).status_code for one in working] == [200, 200]
    assert sqlite_client.post(PATH, json=body(FIT)).status_code == 200


METHODS: list[Method] = [
    CentroidMethod(), FitMethod(), FitMethod(background="slope", width_log_sigma=0.0),
    ChainMethod(), passive_chain(), MatchedMethod(width_px=1.5), MatchedMethod(noise="model"),
]  # fmt: skip


@pytest.mark.slow
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([64, 200, 700]),
    st.sampled_from(METHODS),
    st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_any_line_gives_an_answer(seed: int, pixels: int, method: Method, known: bool) -> None:
    """Positions lie on the line, all numbers are JSON's, and detail changes no peak."""
    lines = varied_lines(8, pixels, np.random.default_rng(seed))
    noise = NOISE.model_copy(update={"full_scale_counts": 65535}) if known else None
    found = find_peaks(lines, method, noise, detail=True)
    assert find_peaks(lines, method, noise).scans == [
        scan.model_copy(update={"windows": None, "stages": None}) for scan in found.scans
    ]
    json.dumps(found.model_dump(), allow_nan=False)
    for scan in found.scans:
        places = [peak.position_px for peak in scan.peaks]
        assert places == sorted(places)
        assert all(-1.0 <= place <= pixels for place in places)
        assert all(peak.sigma_px is None or peak.sigma_px > 0.0 for peak in scan.peaks)
