"""Registrations of three markers and by surfaces: found, kept, and refused with the reason."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_matrix, rotation_vector
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.tools.registrations import measured_points
from service.database.models import RegistrationRow
from service.pipeline.frame_batch import FrameBatch
from service.settings import Settings
from tests.service.api.tools.batches import SIGMA_MM, pose, tool_batch
from tests.service.api.tools.test_capture_and_calibration import IMAGE, registration
from tests.service.api.tools.test_pose_query import put
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

Array = np.ndarray[Any, np.dtype[np.float64]]

URL = "/api/v1/registrations"
TURN, AT = rotation_matrix(np.array([0.2, -0.3, 1.0])), np.array([50.0, 60.0, 1500.0])
PLATE = np.array([[10.0, -20.0, 1500.0], [110.0, -20.0, 1500.0], [10.0, 60.0, 1500.0]])
MARKERS = {
    "id": "plate",
    "kind": "three-markers",
    "device_id": "sim",
    "measured_mm": PLATE.tolist(),
    "measured_sigma_mm": 0.05,
}
SHOWN = MovingTools((MovingTool(((0.0, 0.0, 0.0),) * 8),))
NOW = {"id": "now", "kind": "three-markers", "device_id": "sim", "duration_s": 0.02}


@pytest.fixture
def running(live: FakePipeline) -> FakePipeline:
    """A device that strobes eight markers."""
    live.records = SimulatedDriver("sim", SimulationSettings(scene=SHOWN)).description
    return live


def head(count: int = 400) -> tuple[Array, Any]:
    """Return the mesh of a body without symmetry, in the image's frame."""
    way = np.random.default_rng(0).normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    x, y, z = way.T
    size = 1.0 + 0.15 * x**3 + 0.2 * y * z + 0.1 * x * y
    return way * [60.0, 80.0, 110.0] * size[:, None], ConvexHull(way).simplices


def on(vertices: Array, faces: Any, count: int, seed: int = 1) -> Array:
    chance = np.random.default_rng(seed)
    corners = vertices[faces[chance.integers(len(faces), size=count)]]
    found: Array = np.einsum("ni,nij->nj", chance.dirichlet([1.0, 1.0, 1.0], count), corners)
    return found


def by_skin(**changes: Any) -> dict[str, Any]:
    """A request whose points are where TURN and AT put them, with 0.2 mm of noise."""
    vertices, faces = head()
    noise = np.random.default_rng(2).normal(0.0, 0.2, (120, 3))
    points = on(vertices, faces, 120) @ TURN.T + AT + noise
    surface = {"kind": "mesh", "vertices_mm": vertices.tolist(), "triangles": faces.tolist()}
    request = {
        "id": "skin",
        "kind": "surface",
        "device_id": "sim",
        "parent_id": "ct",
        "points_mm": points.tolist(),
        "surface": surface,
        # Other starts take thirteen times as long.
        "initial_rotation_tolerance_deg": 0,
        "initial_shift_tolerance_mm": 0,
    }
    return request | changes


def roughly(client: Any, **changes: Any) -> Any:
    """The registration to be refined: some 1.5 degrees and 2 mm off."""
    turn = rotation_matrix(np.array([0.02, -0.015, 0.01])) @ TURN
    measured = IMAGE @ turn.T + AT + [1.0, -1.5, 1.0]
    answer = client.post(URL, json=registration(measured, measured_sigma_mm=2.0) | changes)
    assert answer.status_code == 201, answer.text
    return answer.json()


def test_three_markers_make_the_frame_of_figure_7_6(client: Any, live: FakePipeline):
    target = {"name": "T", "frame_mm": [50.0, 20.0, 100.0]}
    answer = client.post(URL, json=MARKERS | {"targets": [target], "note": "plate"})
    assert answer.status_code == 201, answer.text
    found = answer.json()
    np.testing.assert_allclose(np.array(found["matrix"])[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.array(found["matrix"])[:3, 3], PLATE[0])
    assert (found["kind"], found["calibration_id"]) == ("three-markers", "sim-nominal")
    assert found["fre_mm"] is found["fle_mm"] is found["surface"] is None
    assert [one["name"] for one in found["markers"]] == ["M1", "M2", "M3"]
    assert found["markers"][2]["measured_mm"] == [10, 60, 1500]
    assert found["markers"][2]["frames"] is None
    assert found["request"]["measured_sigma_mm"] == 0.05
    # About x, which M1M2 is: M1's and M3's noise along z, over 80 mm.
    sd = np.sqrt(np.diag(found["covariance"]))
    np.testing.assert_allclose(sd[0], np.sqrt(2.0) * 0.05 / 80.0, rtol=1e-6)
    np.testing.assert_allclose(sd[3:], 0.05)
    assert found["targets"][0]["error_mm"] > 0.05 * np.sqrt(3.0)
    assert client.get(f"{URL}/plate").json() == found
    # Poses are given in it.
    assert made(client, POINTER).status_code == 201
    put(live, pose("pointer", 7, np.eye(3), PLATE[0] + [150.0, 10.0, 0.0]))
    asked = client.get("/api/v1/tools/pointer/pose", params={"frame_id": "plate"}).json()
    np.testing.assert_allclose(asked["tip_mm"], [0.0, 10.0, 0.0], atol=1e-9)


NO_FRAMES: list[tuple[Any, ...]] = [
    ({"measured_mm": [[0, 0, 0], [50, 0, 0], [120, 1, 0]]}, "collinear-points", "120 mm long"),
    ({"measured_mm": [[0, 0, 0], [50, 0, 0], [0, 0, 0]]}, "duplicate-point", "M1 and M3"),
    ({"measured_sigma_mm": 60.0}, "undetermined-parameters", "too near"),
    ({"measured_sigma_mm": None}, "invalid-parameter", "measured_sigma_mm"),
    ({"measured_mm": None}, "invalid-parameter", "strobe_markers"),
    (
        {"measured_covariance_mm2": [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]] * 3},
        "invalid-parameter",
        "one of the two",
    ),
    ({"strobe_markers": [0, 1, 2]}, "invalid-parameter", "not both"),
    (
        {
            "measured_sigma_mm": None,
            "measured_covariance_mm2": [[[1, 0, 0], [0, 1, 0], [0, 0, -1]]] * 3,
        },
        "invalid-parameter",
        "M1",
    ),
    ({"id": "tracker"}, "invalid-parameter", '"tracker"'),
]


def test_markers_that_make_no_frame_are_refused(sqlite_client: Any):
    for changes, problem, words in NO_FRAMES:
        answer = sqlite_client.post(URL, json=MARKERS | changes)
        assert code(answer) == (422, problem), answer.text
        assert words in answer.json()["detail"]
    assert sqlite_client.get(URL).json()["items"] == []


def test_a_frame_whose_turn_is_hardly_known_is_told_of(sqlite_client: Any):
    loose = sqlite_client.post(URL, json=MARKERS | {"measured_sigma_mm": 2.0}).json()
    assert "degrees" in loose["warnings"][0]
    assert sqlite_client.post(URL, json=MARKERS | {"id": "firm"}).json()["warnings"] == []


def strobed(reference: list[ToolPose], count: int = 240) -> FrameBatch:
    """Frames that strobe the plate's markers as 4, 5 and 6, with the poses of the reference."""
    return tool_batch([reference], dict(zip((4, 5, 6), PLATE, strict=True)))


def patient(count: int, rotation: Array = TURN, at: Array = AT) -> list[ToolPose]:
    return [pose("patient", n, rotation, at) for n in range(count)]


@pytest.mark.slow
def test_three_strobed_markers_measured_now(client: Any, running: FakePipeline):
    running.batches = [strobed(patient(240))]
    answer = client.post(URL, json=NOW | {"strobe_markers": [4, 5, 6]})
    assert answer.status_code == 201, answer.text
    found = answer.json()
    places = np.array([one["measured_mm"] for one in found["markers"]])
    np.testing.assert_allclose(places, PLATE, atol=6 * SIGMA_MM / np.sqrt(80))
    assert [one["frames"] for one in found["markers"]] == [80, 80, 80]
    assert found["request"]["strobe_markers"] == [4, 5, 6]
    assert found["calibration_id"] == "sim-nominal"
    # Exchanged numbers are another frame.
    other = client.post(URL, json=NOW | {"id": "other", "strobe_markers": [5, 4, 6]}).json()
    np.testing.assert_allclose(np.array(other["matrix"])[:3, 3], PLATE[1], atol=0.1)


def test_relative_to_a_reference_the_patient_may_move(sqlite_client: Any, running: FakePipeline):
    """The plate is fixed to the patient, who moves by 100 mm and turns meanwhile."""
    assert made(sqlite_client, PATIENT).status_code == 201
    batch = strobed(patient(240))
    poses = []
    for n in range(240):
        turn = rotation_matrix(np.array([0.0, 0.0, 0.2 * n / 240]))
        shift = np.array([100.0 * n / 240, 0.0, 0.0])
        poses.append(pose("patient", n, turn, shift))
        batch.points.position_mm[n] = turn @ batch.points.position_mm[n] + shift
    moving = strobed(poses)
    moving.points.position_mm[:] = batch.points.position_mm
    running.batches = [moving]
    request = NOW | {"strobe_markers": [4, 5, 6]}
    assert code(sqlite_client.post(URL, json=request)) == (422, "not-stationary")
    answer = sqlite_client.post(URL, json=request | {"reference_id": "patient"})
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert found["reference_id"] == "patient"
    places = np.array([one["measured_mm"] for one in found["markers"]])
    np.testing.assert_allclose(places, PLATE, atol=0.05)
    # Of what all exposures share, the pose's errors 1.5 m away, no mean makes less.
    sd = np.sqrt(np.trace(np.array(found["markers"][0]["covariance_mm2"])))
    assert sd > 0.2


def test_a_reference_that_is_not_seen_is_told(sqlite_client: Any, running: FakePipeline):
    assert made(sqlite_client, PATIENT).status_code == 201
    lost = [
        ToolPose("patient", PoseStatus.MISSING, "1 of 4 markers was seen", n, n) for n in range(240)
    ]
    running.batches = [strobed(lost)]
    request = NOW | {"strobe_markers": [4, 5, 6], "reference_id": "patient"}
    answer = sqlite_client.post(URL, json=request)
    assert code(answer) == (409, "nothing-seen"), answer.text
    assert '240 more the reference "patient" had no pose' in answer.json()["detail"]
    assert "1 of 4 markers was seen" in answer.json()["detail"]


NOT_MEASURED: list[tuple[Any, ...]] = [
    ({"strobe_markers": [4, 5, 8]}, (422, "invalid-parameter"), "no strobed marker 8"),
    ({"strobe_markers": [4, 5, 4]}, (422, "invalid-parameter"), "[4, 5, 4]"),
    ({"strobe_markers": [4, 5, 7]}, (409, "nothing-seen"), "7: 0"),
    ({"measured_sigma_mm": 0.1}, (422, "invalid-parameter"), "leave them out"),
    ({"reference_id": "nobody"}, (404, "unknown-tool"), '"nobody"'),
    ({"device_id": "nobody"}, (404, "unknown-device"), '"nobody"'),
]


def test_strobed_markers_that_cannot_be_measured(sqlite_client: Any, running: FakePipeline):
    running.batches = [strobed(patient(240))]
    for changes, problem, words in NOT_MEASURED:
        answer = sqlite_client.post(URL, json=NOW | {"strobe_markers": [4, 5, 6]} | changes)
        assert code(answer) == problem, answer.text
        assert words in answer.json()["detail"]


def test_what_was_measured_with_another_calibration_is_not_kept(
    sqlite_client: Any, running: FakePipeline
):
    """The live side has switched already, or not yet."""
    running.batches = [replace(strobed(patient(240)), calibration_id="another")]
    answer = sqlite_client.post(URL, json=NOW | {"strobe_markers": [4, 5, 6]})
    assert code(answer) == (409, "calibration-switched"), answer.text
    running.batches = [replace(strobed(patient(240)), calibration_id=None)]
    answer = sqlite_client.post(URL, json=NOW | {"strobe_markers": [4, 5, 6]})
    assert code(answer) == (409, "no-active-calibration"), answer.text
    running.batches = [strobed(patient(90)), replace(strobed(patient(90)), table_id="map")]
    answer = sqlite_client.post(URL, json=NOW | {"strobe_markers": [4, 5, 6]})
    assert code(answer) == (409, "calibration-switched"), answer.text


def test_a_surface_refines_a_registration(client: Any):
    parent = roughly(client)
    target = {"name": "T", "frame_mm": [20.0, 10.0, 30.0]}
    answer = client.post(URL, json=by_skin(targets=[target], note="skin"))
    assert answer.status_code == 201, answer.text
    found = answer.json()
    matrix = np.array(found["matrix"])
    np.testing.assert_allclose(matrix[3], [0.0, 0.0, 0.0, 1.0])

    def off(one: Array) -> float:
        place = np.array([*target["frame_mm"], 1.0])
        return float(np.linalg.norm((one @ place)[:3] - (TURN @ place[:3] + AT)))

    assert off(matrix) < 0.3 < off(np.array(parent["matrix"]))
    error = np.concatenate([rotation_vector(matrix[:3, :3] @ TURN.T), matrix[:3, 3] - AT])
    assert error @ np.linalg.solve(np.array(found["covariance"]), error) < 40.0
    fit = found["surface"]
    assert 0.05 < fit["rms_mm"] < 0.3
    assert (fit["points"], len(fit["used"]), len(fit["distance_mm"])) == (108, 120, 120)
    assert fit["stiffness_ratio"] > 1e-3
    assert fit["weakest_motion"].startswith(("a rotation about", "a shift along"))
    assert 1.0 < fit["rotation_deg"] < 2.0
    assert fit["alternative"] is None
    assert (found["kind"], found["parent_id"]) == ("surface", "ct")
    assert found["parent_created_at"] == parent["created_at"]
    assert found["targets"][0]["error_mm"] < 0.3
    kept = found["request"]["surface"]
    assert (kept["kind"], kept["vertices"]) == ("mesh", 400)
    assert "vertices_mm" not in kept
    assert found["request"]["points_mm"] == by_skin()["points_mm"]
    assert client.get(f"{URL}/skin").json() == found
    assert found["warnings"] == []
    # It needs the earlier one no more, and may be refined itself.
    again = client.post(URL, json=by_skin(id="again", parent_id="skin")).json()
    assert again["parent_id"] == "skin"
    assert again["surface"]["rotation_deg"] < 0.1
    assert again["request"]["surface"] == kept
    assert client.delete(f"{URL}/ct").status_code == 204
    assert client.get(f"{URL}/skin").json() == found


def test_what_is_further_off_than_it_may_be_is_refused(sqlite_client: Any):
    """The frame would be in use at once; 0 judges nothing."""
    roughly(sqlite_client)
    points = by_skin()["points_mm"][:40]  # other starts are looked at, too: that takes its time
    for changes, words in (
        ({"initial_rotation_tolerance_deg": 0.5}, "degrees from where"),
        ({"initial_shift_tolerance_mm": 0.5}, "mm from where"),
    ):
        answer = sqlite_client.post(URL, json=by_skin(points_mm=points, **changes))
        assert code(answer) == (422, "high-error"), answer.text
        (name,) = changes
        told = answer.json()
        assert told["context"]["found"] > told["context"][name] == 0.5
        assert words in told["detail"]
        assert f"{name} is 0.5" in told["detail"]
    assert len(sqlite_client.get(URL).json()["items"]) == 1


def test_a_surface_of_points_with_their_normals(sqlite_client: Any):
    roughly(sqlite_client)
    vertices, _ = head(1500)
    hull = ConvexHull(vertices)
    normals = np.zeros_like(vertices)
    for face, way in zip(hull.simplices, hull.equations[:, :3], strict=True):
        normals[face] += way
    shown = hull.vertices
    points = {"kind": "points", "points_mm": vertices[shown].tolist()}
    with_normals = points | {"normals": normals[shown].tolist()}
    answer = sqlite_client.post(URL, json=by_skin(surface=with_normals))
    assert answer.status_code == 201, answer.text
    assert answer.json()["request"]["surface"]["triangles"] is None
    short = points | {"normals": normals[:5].tolist()}
    refused = sqlite_client.post(URL, json=by_skin(id="short", surface=short))
    assert code(refused) == (422, "invalid-parameter"), refused.text


def test_what_a_surface_does_not_hold_is_refused_with_the_motion(sqlite_client: Any):
    """A plane: points slide along it, and turn about its normal, z of the image."""
    roughly(sqlite_client)
    surface = {
        "kind": "mesh",
        "vertices_mm": [[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]],
        "triangles": [[0, 1, 2], [0, 2, 3]],
    }
    flat = np.random.default_rng(3).uniform(-50.0, 50.0, (40, 3)) * [1.0, 1.0, 0.0]
    request = by_skin(surface=surface, points_mm=(flat @ TURN.T + AT).tolist())
    answer = sqlite_client.post(URL, json=request)
    assert code(answer) == (422, "undetermined-parameters"), answer.text
    assert "does not hold a " in answer.json()["detail"]
    context = answer.json()["context"]
    assert context["stiffness_ratio"] < 1e-9
    assert context["motion"].startswith(("a rotation about", "a shift along"))


NOTHING_REFINED: list[tuple[Any, ...]] = [
    ({"parent_id": "nobody"}, (404, "unknown-registration"), '"nobody"'),
    ({"id": "ct"}, (409, "registration-exists"), '"ct"'),
    ({"points_mm": [[0, 0, 0]] * 11}, (422, "invalid-request"), ""),
    ({"max_rms_mm": 0.01}, (422, "high-error"), "0.01 mm"),
    (
        {
            "surface": {
                "kind": "mesh",
                "vertices_mm": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
                "triangles": [[0, 1, 3]],
            }
        },
        (422, "invalid-parameter"),
        "vertices",
    ),
    (
        {"surface": {"kind": "points", "points_mm": [[0, 0, 0]]}},
        (422, "too-few-points"),
        "12 or more",
    ),
]


def test_a_surface_that_refines_nothing_says_why(sqlite_client: Any):
    roughly(sqlite_client)
    for changes, problem, words in NOTHING_REFINED:
        answer = sqlite_client.post(URL, json=by_skin(**changes))
        assert code(answer) == problem, answer.text
        assert words in answer.json().get("detail", "")
    assert len(sqlite_client.get(URL).json()["items"]) == 1


def test_sizes_have_their_limits(sqlite_client: Any, sqlite_settings: Settings):
    roughly(sqlite_client)
    for change, words in (
        ({"surface_points": 119}, "points_mm has 120 items; this server takes 119"),
        ({"surface_size": 399}, "surface.vertices_mm has 400 items; this server takes 399"),
        ({"surface_size": 400}, "surface.triangles has"),
    ):
        sqlite_client.app.state.settings = sqlite_settings.model_copy(update=change)
        answer = sqlite_client.post(URL, json=by_skin())
        assert code(answer) == (422, "invalid-parameter"), answer.text
        assert words in answer.json()["detail"]


def test_a_frame_of_another_calibration_is_not_refined(sqlite_client: Any):
    roughly(sqlite_client)
    with sqlite_client.app.state.database.write() as session:
        row = session.get(RegistrationRow, "ct")
        found = {name: getattr(row, name) for name in ("asked", "note", "created_at", "device_id")}
        older = row.result | {"calibration_id": "older"}
        session.add(RegistrationRow(id="older", reference_id=None, result=older, **found))
    answer = sqlite_client.post(URL, json=by_skin(parent_id="older"))
    assert code(answer) == (422, "invalid-parameter"), answer.text
    assert '"older"' in answer.json()["detail"]
    assert '"sim-nominal"' in answer.json()["detail"]


def test_of_those_before_there_were_kinds_all_is_told(client: Any):
    """A row as the version before wrote it: without a kind, parent or surface."""
    now = roughly(client, id="now")
    with client.app.state.database.write() as session:
        row = session.get(RegistrationRow, "now")
        asked = {name: value for name, value in row.asked.items() if name != "kind"}
        session.add(
            RegistrationRow(
                id="then",
                device_id="sim",
                reference_id=None,
                asked=asked,
                result=row.result,
                note="",
                created_at=row.created_at,
            )
        )
    found = client.get(f"{URL}/then").json()
    assert found == now | {"id": "then"}
    assert found["kind"] == found["request"]["kind"] == "paired-points"
    # And it may be refined.
    answer = client.post(URL, json=by_skin(parent_id="then"))
    assert answer.status_code == 201, answer.text


def test_an_error_in_a_body_is_where_it_was_without_kinds(sqlite_client: Any):
    body = registration(IMAGE)
    body["fiducials"][1]["frame_mm"] = [0.0, "1", 2.0]
    for kind in ({}, {"kind": "paired-points"}):
        (error,) = sqlite_client.post(URL, json=body | kind).json()["errors"]
        assert error["location"] == ["body", "fiducials", 1, "frame_mm", 1]
    (error,) = sqlite_client.post(URL, json=body | {"kind": "guess"}).json()["errors"]
    assert error["location"] == ["body"]
    assert "paired-points, three-markers or surface" in error["message"]


def test_what_was_measured_has_names_and_places(sqlite_client: Any):
    """As those are told who are given landmarks; points on a surface have no names."""
    roughly(sqlite_client)
    sqlite_client.post(URL, json=MARKERS)
    sqlite_client.post(URL, json=by_skin())
    with sqlite_client.app.state.database.read() as session:
        rows = {name: session.get(RegistrationRow, name) for name in ("ct", "plate", "skin")}
        places = {name: measured_points(row) for name, row in rows.items()}
    assert [name for name, _ in places["ct"]] == ["F0", "F1", "F2", "F3", "F4"]
    assert places["plate"] == [(f"M{n + 1}", tuple(one)) for n, one in enumerate(PLATE.tolist())]
    assert places["skin"] == []


def test_who_registered_what_is_written_down(sqlite_client: Any):
    roughly(sqlite_client)
    sqlite_client.post(URL, json=MARKERS)
    sqlite_client.post(URL, json=by_skin())
    entries = sqlite_client.get("/api/v1/audit", params={"limit": 3}).json()["items"]
    assert [(one["operation"], one["outcome"], one["object_id"]) for one in entries] == [
        ("create-registration", "done", "skin"),
        ("create-registration", "done", "plate"),
        ("create-registration", "done", "ct"),
    ]
