"""Tools captured, pivoted and spun from what a device shows; registrations of paired points."""

from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from compute.quality.accuracy import MarkerTrack
from compute.transform import rotation_matrix
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.tools import concurrency_limits, tip_calibration
from service.api.tools.geometry_capture import in_canonical_order, principal_axes
from tests.service.api.tools.batches import TIP_MM, pivoting, spinning, tool_batch
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

SHAPE = np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 15.0, 40.0]])
SHOWN = MovingTools((MovingTool(tuple(map(tuple, SHAPE.tolist()))),))
ASKED = {"id": "shown", "device_id": "sim", "title": "Shown", "strobe_markers": [0, 1, 2, 3]}


@pytest.fixture
def running(live: FakePipeline) -> FakePipeline:
    """A device that strobes four markers."""
    live.records = SimulatedDriver("sim", SimulationSettings(scene=SHOWN)).description
    return live


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are collected until there are 100, and not for as long as is asked."""
    monkeypatch.setattr(tip_calibration, "MAX_COLLECTED", 100)


def placed() -> dict[int, np.ndarray]:
    points = SHAPE @ rotation_matrix(np.array([0.4, 0.9, -0.3])).T + [10.0, 20.0, 1500.0]
    return dict(enumerate(points))


def test_a_tool_is_what_it_shows(sqlite_client: Any, running: FakePipeline):
    batch = tool_batch([pivoting("none", 400)], placed())
    running.batches = [replace(batch, table_id="map")]
    answer = sqlite_client.post("/api/v1/tool-captures", json=ASKED | {"duration_s": 0.05})
    assert answer.status_code == 201, answer.text
    tool = answer.json()
    markers = np.array(tool["markers_mm"])
    # 100 frames of each with 0.02 mm along each axis: 0.002 mm, and six deviations are enough.
    np.testing.assert_allclose(pdist(markers), pdist(SHAPE), atol=6 * np.sqrt(2) * 0.02 / 10)
    np.testing.assert_allclose(markers.mean(axis=0), 0.0, atol=1e-9)
    assert (tool["origin"]["kind"], tool["origin"]["calibration_id"]) == ("captured", "sim-nominal")
    assert (tool["origin"]["table_id"], tool["origin"]["frames"]) == ("map", 100)
    # At least the noise over the root of the frames, at most all of it, as if it were common.
    sigma = np.array(tool["origin"]["sigma_mm"])
    assert (sigma > 0.5 * 0.02 * np.sqrt(3) / 10).all()
    assert (sigma < 1.5 * 0.02 * np.sqrt(3)).all()
    assert tool["strobe_markers"] == [0, 1, 2, 3]
    edges, original = np.diff(markers, axis=0), np.diff(SHAPE, axis=0)
    assert np.linalg.det(edges) == pytest.approx(np.linalg.det(original), rel=1e-2)  # not mirrored


@pytest.mark.parametrize(
    ("changes", "points", "problem", "words"),
    [
        ({}, {0: 0, 1: 1, 2: 2}, (409, "nothing-seen"), "3: 0"),
        ({"strobe_markers": [0, 1, 7]}, {}, (422, "invalid-parameter"), "marker 7"),
        ({"strobe_markers": None}, {}, (422, "invalid-parameter"), "strobe_markers"),
        (
            {"strobe_markers": None, "markers": 4},
            {},
            (422, "invalid-parameter"),
            "numbers 0 to 3",
        ),
        ({"device_id": "nothing"}, {}, (404, "unknown-device"), "nothing"),
    ],
)
def test_a_capture_that_cannot_be_says_why(
    sqlite_client: Any,
    running: FakePipeline,
    changes: dict[str, Any],
    points: dict[int, int],
    problem: tuple[int, str],
    words: str,
):
    shown = {marker: placed()[number] for marker, number in points.items()}
    running.batches = [tool_batch([pivoting("none", 60)], shown or None)]
    request = ASKED | {"duration_s": 0.05} | changes
    answer = sqlite_client.post("/api/v1/tool-captures", json=request)
    assert code(answer) == problem, answer.text
    assert words in answer.json()["detail"]


def test_a_tool_that_moves_is_not_captured(sqlite_client: Any, running: FakePipeline):
    batch = tool_batch([pivoting("none", 400)], placed())
    batch.points.position_mm[:, 0] += np.linspace(0.0, 5.0, 400)
    running.batches = [batch]
    answer = sqlite_client.post("/api/v1/tool-captures", json=ASKED | {"duration_s": 0.05})
    assert code(answer) == (422, "not-stationary")


@given(
    seed=st.integers(0, 2**32 - 1),
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    at=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_principal_axes_do_not_depend_on_where_it_was_shown(
    seed: int, turn: tuple[float, float, float], at: tuple[float, float, float]
):
    shape = np.random.default_rng(seed).normal(size=(5, 3)) * [80.0, 50.0, 25.0]
    moved = shape @ rotation_matrix(np.array(turn)).T + at
    found = principal_axes(moved)
    np.testing.assert_allclose(found, principal_axes(shape), atol=1e-6)
    np.testing.assert_allclose(pdist(found), pdist(shape), atol=1e-9)
    spread = (found**2).sum(axis=0)
    assert spread[0] >= spread[1] >= spread[2]


def test_points_that_are_lit_together_are_put_in_order():
    rng = np.random.default_rng(3)
    frames, markers = 200, 4
    shown = SHAPE + rng.normal(0.0, 0.05, (frames, markers, 3))
    order = np.array([rng.permutation(markers) for _ in range(frames)])
    shuffled = np.take_along_axis(shown, order[..., None], axis=1)
    shuffled[50, 1] = shuffled[50, 0]  # a frame that shows one marker twice is none to use
    times = np.arange(frames) * 1e-3
    # Each marker's covariance is told from the others', and goes with it.
    spread = order[..., None, None] * np.eye(3)
    found = in_canonical_order(
        [MarkerTrack(times, shuffled[:, n], spread[:, n]) for n in range(markers)]
    )
    assert {len(track.time_s) for track in found} == {frames - 1}
    means = np.array([track.position_mm.mean(axis=0) for track in found])
    np.testing.assert_allclose(means, SHAPE[order[0]], atol=0.05)
    assert max(track.position_mm.std(axis=0).max() for track in found) < 0.1
    for marker, track in zip(order[0], found, strict=True):
        assert (track.covariance_mm2[:, 0, 0] == marker).all()


def test_a_pointer_gets_the_tip_that_it_was_pivoted_about(
    client: Any, running: FakePipeline, soon: None
):
    assert made(client, POINTER, tip_mm=None).status_code == 201
    running.batches = [replace(tool_batch([pivoting("pointer", 100)]), table_id="map")]
    answer = client.post("/api/v1/tools/pointer/pivot-calibrations", json={})
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert (found["calibration_id"], found["table_id"]) == ("sim-nominal", "map")
    covariance = np.array(found["tip_covariance_mm2"])
    error = np.array(found["tip_mm"]) - TIP_MM
    assert error @ np.linalg.solve(covariance, error) < 30.0  # chi-square of 3: 1e-6 beyond it
    assert np.sqrt(np.trace(covariance)) < 0.1
    assert (found["kind"], found["applied"], found["poses"]) == ("pivot", True, 100)
    assert found["rms_mm"] < 0.2
    tip = client.get("/api/v1/tools/pointer").json()["tip"]
    assert tip["position_mm"] == found["tip_mm"]
    assert (tip["tool_calibration_id"], tip["covariance_mm2"]) == (
        found["id"],
        found["tip_covariance_mm2"],
    )
    (followed,) = running.tracked["sim"].tools
    assert followed.tip_mm == tuple(found["tip_mm"])
    kept = client.get("/api/v1/tools/pointer/calibrations").json()["items"]
    assert kept == [found]


def test_a_calibration_that_is_not_applied_is_kept_all_the_same(
    sqlite_client: Any, running: FakePipeline, soon: None
):
    assert made(sqlite_client, POINTER).status_code == 201
    before = sqlite_client.get("/api/v1/tools/pointer").json()
    running.batches = [tool_batch([spinning("pointer", 100)])]
    path = "/api/v1/tools/pointer/spin-calibrations"
    answer = sqlite_client.post(path, json={"apply": False})
    assert answer.status_code == 201, answer.text
    found = answer.json()
    np.testing.assert_allclose(np.abs(found["axis"]), [0.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(found["point_mm"], [5.0, 0.0, 0.0], atol=0.05)
    assert not found["applied"]
    assert sqlite_client.get("/api/v1/tools/pointer").json() == before
    applied = sqlite_client.post(path, json={}).json()
    after = sqlite_client.get("/api/v1/tools/pointer").json()
    assert after["tip"]["axis"] == applied["axis"]
    assert after["tip"]["position_mm"] == before["tip"]["position_mm"]
    assert sqlite_client.delete("/api/v1/tools/pointer").status_code == 204


def test_relative_to_the_reference_the_fixed_point_may_move(
    sqlite_client: Any, running: FakePipeline, soon: None
):
    """The tool pivots in a dimple of a block that is moved meanwhile, with a reference on it."""
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER, reference_id="patient").status_code == 201
    rng = np.random.default_rng(8)
    tool, block = [], []
    for one in pivoting("pointer", 100):
        turn, at = rotation_matrix(rng.uniform(-0.2, 0.2, 3)), rng.uniform(-50.0, 50.0, 3)
        assert one.rotation is not None
        assert one.translation_mm is not None
        tool.append(
            replace(
                one, rotation=turn @ one.rotation, translation_mm=turn @ one.translation_mm + at
            )
        )
        block.append(replace(one, tool="patient", rotation=turn, translation_mm=at))
    running.batches = [tool_batch([tool, block])]
    path = "/api/v1/tools/pointer/pivot-calibrations"
    found = sqlite_client.post(path, json={})
    assert found.status_code == 201, found.text
    # The block's turns, known to 0.2 mrad, sweep the fixed point 1.5 m away by 0.3 mm.
    np.testing.assert_allclose(found.json()["tip_mm"], TIP_MM, atol=1.0)
    world = sqlite_client.post(path, json={"relative": False})
    assert world.status_code == 422, world.text


@pytest.mark.parametrize(
    ("poses", "problem", "words"),
    [
        (pivoting("pointer", 100, swing_rad=0.01), "too-little-rotation", "rad"),
        (pivoting("pointer", 5), "too-few-poses", "5"),
        (pivoting("other", 100), "too-few-poses", "no frame"),
    ],
)
def test_a_pivot_that_says_nothing_is_refused(
    sqlite_client: Any,
    running: FakePipeline,
    soon: None,
    poses: list[Any],
    problem: str,
    words: str,
):
    assert made(sqlite_client, POINTER).status_code == 201
    running.batches = [tool_batch([poses])]
    path = "/api/v1/tools/pointer/pivot-calibrations"
    answer = sqlite_client.post(path, json={"duration_s": 0.05})
    assert code(answer) == (422, problem), answer.text
    assert sqlite_client.get("/api/v1/tools/pointer/calibrations").json()["items"] == []


@pytest.mark.parametrize(
    ("kind", "poses"),
    [
        ("pivot", pivoting("pointer", 100)),
        ("pivot", pivoting("pointer", 100, swing_rad=0.06)),
        ("spin", spinning("pointer", 15)[:2] * 50),
    ],
)
def test_a_calibration_swings_as_far_as_was_asked_for(
    sqlite_client: Any, running: FakePipeline, soon: None, kind: str, poses: list[Any]
):
    assert made(sqlite_client, POINTER).status_code == 201
    running.batches = [tool_batch([poses])]
    path = f"/api/v1/tools/pointer/{kind}-calibrations"
    found = sqlite_client.post(path, json={"min_swing_deg": 0.1})
    assert found.status_code == 201, found.text
    reached_deg = found.json()["smallest_rotation_deg"]
    assert sqlite_client.post(path, json={"min_swing_deg": reached_deg - 0.1}).status_code == 201
    refused = sqlite_client.post(path, json={"min_swing_deg": reached_deg + 0.1})
    assert code(refused) == (422, "too-little-rotation"), refused.text
    assert f"at least {reached_deg + 0.1:.1f} deg" in refused.json()["detail"]


def test_a_calibration_switched_meanwhile_spoils_it(
    sqlite_client: Any, running: FakePipeline, soon: None
):
    assert made(sqlite_client, POINTER).status_code == 201
    running.batches = [
        tool_batch([pivoting("pointer", 20)]),
        tool_batch([pivoting("pointer", 20)], calibration="another"),
    ]
    path = "/api/v1/tools/pointer/pivot-calibrations"
    answer = sqlite_client.post(path, json={"duration_s": 0.05})
    assert code(answer) == (409, "calibration-switched")


def test_nothing_is_measured_of_a_device_that_does_not_run(sqlite_client: Any):
    assert made(sqlite_client, POINTER).status_code == 201
    for path, body in (
        ("tools/pointer/pivot-calibrations", {}),
        ("tools/pointer/spin-calibrations", {}),
        ("tool-captures", ASKED | {"strobe_markers": [7, 8, 9]}),
    ):
        answer = sqlite_client.post(f"/api/v1/{path}", json=body)
        assert code(answer) == (409, "device-not-running")


IMAGE = np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100], [60, 70, 80]], float)


def registration(measured: np.ndarray, **changes: Any) -> dict[str, Any]:
    pairs = [
        {"name": f"F{n}", "frame_mm": one.tolist(), "measured_mm": other.tolist()}
        for n, (one, other) in enumerate(zip(IMAGE, measured, strict=False))
    ]
    return {"id": "ct", "device_id": "sim", "fiducials": pairs} | changes


def test_a_registration_and_what_it_is_worth(client: Any):
    turn, at = rotation_matrix(np.array([0.2, -0.3, 1.0])), np.array([50.0, 60.0, 1500.0])
    noise = np.random.default_rng(4).normal(0.0, 0.1, IMAGE.shape)
    target = {"name": "T", "frame_mm": [30.0, 30.0, 30.0]}
    request = registration(
        IMAGE @ turn.T + at + noise, measured_sigma_mm=0.1, targets=[target], note="first"
    )
    answer = client.post("/api/v1/registrations", json=request)
    assert answer.status_code == 201, answer.text
    found = answer.json()
    matrix = np.array(found["matrix"])
    error = matrix[:3, :3] @ target["frame_mm"] + matrix[:3, 3] - (turn @ target["frame_mm"] + at)
    (there,) = found["targets"]
    assert error @ np.linalg.solve(np.array(there["covariance_mm2"]), error) < 30.0
    assert there["error_mm"] == pytest.approx(np.sqrt(np.trace(there["covariance_mm2"])))
    assert 0.03 < there["error_mm"] < 0.2
    assert found["fre_mm"] == pytest.approx(
        np.sqrt(np.mean([one["error_mm"] ** 2 for one in found["fiducials"]]))
    )
    assert [one["name"] for one in found["fiducials"]] == ["F0", "F1", "F2", "F3", "F4"]
    assert client.get("/api/v1/registrations/ct").json() == found
    assert client.get("/api/v1/registrations").json()["items"] == [found]
    again = client.post("/api/v1/registrations", json=request)
    assert code(again) == (409, "registration-exists")
    assert code(made(client, POINTER, id="ct")) == (409, "tool-exists")
    assert client.delete("/api/v1/registrations/ct").status_code == 204
    assert code(client.get("/api/v1/registrations/ct")) == (404, "unknown-registration")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"device_id": "nothing"}, (404, "unknown-device")),
        ({"reference_id": "nothing"}, (404, "unknown-tool")),
        ({"id": "tracker"}, (422, "invalid-parameter")),
        ({"fiducials": registration(IMAGE[:2])["fiducials"]}, (422, "invalid-request")),
        (
            {
                "fiducials": [
                    {"name": str(n), "frame_mm": [n * 50.0, 0, 0], "measured_mm": [0, n * 50.0, 0]}
                    for n in range(4)
                ]
            },
            (422, "collinear-points"),
        ),
        (
            {"fiducials": [*registration(IMAGE)["fiducials"][:3]] * 2},
            (422, "invalid-parameter"),
        ),
    ],
)
def test_a_registration_that_cannot_be_says_why(
    sqlite_client: Any, changes: dict[str, Any], expected: tuple[int, str]
):
    answer = sqlite_client.post("/api/v1/registrations", json=registration(IMAGE, **changes))
    assert code(answer) == expected, answer.text


def test_a_registration_is_not_called_like_a_tool(sqlite_client: Any):
    assert made(sqlite_client, POINTER).status_code == 201
    answer = sqlite_client.post("/api/v1/registrations", json=registration(IMAGE, id="pointer"))
    assert code(answer) == (409, "registration-exists")


def test_a_tool_made_anew_meanwhile_is_not_given_the_formers_tip(
    sqlite_client: Any, running: FakePipeline, soon: None, monkeypatch: pytest.MonkeyPatch
):
    assert made(sqlite_client, POINTER).status_code == 201
    running.batches = [tool_batch([pivoting("pointer", 100)])]

    def replaced(*asked: Any) -> dict[str, Any]:
        found = measured(*asked)
        assert sqlite_client.delete("/api/v1/tools/pointer").status_code == 204
        assert made(sqlite_client, POINTER, tip_mm=None).status_code == 201
        return found

    measured = tip_calibration.calibrate_tip
    monkeypatch.setattr(tip_calibration, "calibrate_tip", replaced)
    answer = sqlite_client.post("/api/v1/tools/pointer/pivot-calibrations", json={})
    assert code(answer) == (409, "tool-replaced"), answer.text
    assert "created again" in answer.json()["detail"]
    assert sqlite_client.get("/api/v1/tools/pointer").json()["tip"]["position_mm"] is None
    assert sqlite_client.get("/api/v1/tools/pointer/calibrations").json()["items"] == []


@pytest.mark.parametrize("path", ["tools/pointer/pivot-calibrations", "tool-captures"])
def test_no_more_wait_at_once_than_may(sqlite_client: Any, running: FakePipeline, path: str):
    assert made(sqlite_client, POINTER).status_code == 201
    running.batches = [tool_batch([pivoting("pointer", 5)])]
    body = ASKED | {"strobe_markers": [5, 6, 7]} if path == "tool-captures" else {}
    request = body | {"duration_s": 0.05}
    with ExitStack() as others:
        for _ in range(concurrency_limits.MAX_CONCURRENT):
            others.enter_context(concurrency_limits.captures)
        refused = sqlite_client.post(f"/api/v1/{path}", json=request)
        assert code(refused) == (503, "busy"), refused.text
        assert (
            f"{concurrency_limits.MAX_CONCURRENT} captures and calibrations"
            in refused.json()["detail"]
        )
        assert sqlite_client.get("/api/v1/tools/pointer").status_code == 200
    # However the measurement ends, its place is free again.
    for _ in range(concurrency_limits.MAX_CONCURRENT + 1):
        answer = sqlite_client.post(f"/api/v1/{path}", json=request)
        assert answer.status_code in (409, 422), answer.text


def test_a_server_that_stops_says_so_at_once(sqlite_client: Any, running: FakePipeline):
    """It would wait for two minutes."""
    assert made(sqlite_client, POINTER).status_code == 201
    running.streams.close("the server is stopping")
    path = "/api/v1/tools/pointer/pivot-calibrations"
    answer = sqlite_client.post(path, json={"duration_s": 120})
    assert code(answer) == (503, "not-ready"), answer.text
    assert "the server is stopping" in answer.json()["detail"]
