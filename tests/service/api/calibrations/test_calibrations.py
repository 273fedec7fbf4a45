"""Calibrations: made, hashed, activated, retired, never changed; on both databases."""

import hashlib
import json
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from compute.calibration.result import Calibration
from compute.camera.model import PARAMETERS
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.calibrations import store
from service.api.calibrations.calibration_content import content_hash
from service.api.calibrations.examples import simulated_points
from service.database.models import CalibrationRow

URL = "/api/v1/calibrations"
# Every other marker of the calibration frame, twice as far apart. Points on a grid along the axes
# would not do: a sensor along an axis sees only a few different ones.
FRAME = 2.0 * calibration_target_points_mm()[::2]


def body(**changes: Any) -> dict[str, Any]:
    return {"device_id": "sim", "points": simulated_points(FRAME)} | changes


def test_a_calibration_recovers_the_simulators_cameras(client: Any):
    # Ten points say little of distortion; with it, the deviations are large, too.
    made = client.post(URL, json=body(note="ten points", distortion="none"))
    assert made.status_code == 201
    document = made.json()
    assert made.headers["location"] == f"{URL}/{document['id']}"
    assert client.get(made.headers["location"]).json() == document
    assert (document["state"], document["provenance"], document["point_count"]) == (
        "available",
        "fitted",
        10,
    )
    assert document["note"] == "ten points"
    result = TypeAdapter(Calibration).validate_python(document["result"])
    covariance = np.array(result.covariance)
    for index, (model, true) in enumerate(
        zip(result.models, simulated_sensor_models(), strict=True)
    ):
        assert model.name == true.name
        # Readings are rounded to 0.01 px, and the deviations are those of the residuals.
        for parameter in ("principal_distance_px", "offset_x_mm", "offset_z_mm"):
            place = 7 * index + PARAMETERS.index(parameter)
            sigma = np.sqrt(covariance[place, place])
            assert abs(getattr(model, parameter) - getattr(true, parameter)) < 5 * sigma
            assert sigma < 1e-3 * true.principal_distance_px


@pytest.mark.slow
def test_control_point_errors_are_those_of_the_reconstructed_points(client: Any):
    errors = client.post(URL, json=body()).json()["errors"]
    for kind in ("fitted", "leave_one_out"):
        differences = np.array(errors[kind]["differences_mm"])
        assert differences.shape == (10, 3)
        statistics = errors[kind]["statistics"]
        assert statistics["mean_absolute_mm"] == pytest.approx(np.abs(differences).mean(axis=0))
        assert statistics["max_absolute_mm"] == pytest.approx(np.abs(differences).max(axis=0))
    fitted = np.abs(errors["fitted"]["differences_mm"]).mean()
    left_out = np.abs(errors["leave_one_out"]["differences_mm"]).mean()
    assert fitted < left_out


def exchanged(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The points with the first sensor's readings of the third and the seventh exchanged."""
    changed = [point | {"readings": dict(point["readings"])} for point in points]
    name = next(iter(points[0]["readings"]))
    for one, other in ((2, 6), (6, 2)):
        changed[one]["readings"][name] = points[other]["readings"][name]
    return changed


@pytest.mark.parametrize(
    ("options", "readings"),
    [
        ({"labels": "repair"}, 0),
        pytest.param({"labels": "exclude"}, -2, marks=pytest.mark.slow),
        pytest.param({"loss": "robust"}, -2, marks=pytest.mark.slow),
    ],
)
def test_errors_rest_on_the_readings_that_the_calibration_used(
    sqlite_client: Any, options: dict[str, str], readings: int
):
    frame = 2.0 * calibration_target_points_mm()
    right = simulated_points(frame)
    made = sqlite_client.post(URL, json=body(points=exchanged(right)) | options)
    assert made.status_code == 201, made.text
    errors = made.json()["errors"]
    total = sum(len(point["readings"]) for point in right)
    for kind in ("fitted", "leave_one_out", "blocks_left_out"):
        found = errors[kind]
        assert found["readings"] == total + readings
        assert found["statistics"]["points"] == len(frame)
        # Readings are rounded to 0.01 px; one that is wrong is off by hundreds of them.
        assert max(found["statistics"]["max_absolute_mm"]) < 0.5


@pytest.mark.slow
def test_distortion_of_few_points_is_estimated_with_a_reason(sqlite_client: Any):
    corners = np.array(np.meshgrid(*[[-150.0, 150.0]] * 3)).reshape(3, 8).T
    points = simulated_points(corners)
    noise = np.random.default_rng(0)
    for point in points:
        point["readings"] = {
            name: value + noise.normal(0.0, 1.0) for name, value in point["readings"].items()
        }
    made = sqlite_client.post(URL, json=body(points=points, distortion="auto"))
    assert made.status_code == 201, made.text
    found = made.json()["result"]["distortion"]
    assert found["chosen"] == "auto"
    low, high = found["scale_range"]
    assert 0.0 < low < found["scale"] < high
    assert "do not tell whether the lenses distort" in found["reason"]


def test_more_than_a_hundred_points_are_not_left_out_one_by_one(client: Any):
    generator = np.random.default_rng(5)
    many = simulated_points(generator.uniform(-120, 120, (101, 3)))
    refused = client.post(URL, json=body(points=many))
    assert refused.status_code == 422
    assert "POST them to /api/v1/runs/calibration" in refused.json()["detail"]
    plain = body(points=many, distortion="none", labels="off")
    errors = client.post(URL, json=plain).json()["errors"]
    assert errors["leave_one_out"] is None
    assert errors["fitted"]["statistics"]["points"] == 101


def hash_by_the_recipe(document: dict[str, Any]) -> str:
    """The content hash as the guide says, of a calibration that is no updated one."""
    content = {key: document[key] for key in ("provenance", "points", "result")}
    content["device"] = document["device_id"]
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.slow
def test_the_hash_can_be_recomputed_from_the_document(client: Any):
    first = client.post(URL, json=body(note="first")).json()
    second = client.post(URL, json=body(note="second")).json()
    other = client.post(URL, json=body(points=simulated_points(FRAME)[:-1])).json()
    for document in (first, other, client.get(f"{URL}/sim-nominal").json()):
        assert document["content_hash"] == hash_by_the_recipe(document)
    assert first["content_hash"] == second["content_hash"] != other["content_hash"]


def test_what_an_earlier_version_stored_is_sent_as_it_was_hashed(client: Any):
    database = client.app.state.database
    since = {
        "settings", "distortion", "reading_weights", "point_shifts_mm", "labels",
        "cross_validation", "diagnosis",
    }  # fmt: skip
    with database.write() as session:
        nominal = store.get_calibration(session, "sim-nominal")
        result = nominal.content["result"]
        old = {name: value for name, value in result.items() if name not in since}
        assert len(old) == len(result) - len(since)
        content = nominal.content | {"result": old}
        session.add(
            CalibrationRow(
                id="old",
                device_id="sim",
                method=nominal.method,
                provenance=nominal.provenance,
                note="",
                point_count=0,
                content=content,
                errors=nominal.errors,
                content_hash=content_hash(content),
                created_at=datetime.now(UTC),
                retired_at=None,
            )
        )
    found = client.get(f"{URL}/old").json()
    assert set(found["result"]) == set(old)
    assert found["parent"] is None
    assert hash_by_the_recipe(found) == found["content_hash"] == content_hash(content)
    assert TypeAdapter(Calibration).validate_python(found["result"]).labels == ()


def test_given_deviations_make_the_covariance(client: Any):
    def with_sigma(sigma_px: float) -> Any:
        points = simulated_points(FRAME)
        for point in points:
            point["readings"] = {
                name: {"position_px": value, "sigma_px": sigma_px}
                for name, value in point["readings"].items()
            }
        return client.post(URL, json=body(points=points, distortion="none")).json()["result"]

    one, ten = with_sigma(0.01), with_sigma(0.1)
    assert {fit["sigma_source"] for fit in one["sensors"]} == {"given"}
    assert np.array(ten["covariance"]) == pytest.approx(100 * np.array(one["covariance"]), rel=1e-3)


def test_deviations_for_some_readings_only_are_refused(client: Any):
    points = simulated_points(FRAME)
    name, value = next(iter(points[0]["readings"].items()))
    points[0]["readings"][name] = {"position_px": value, "sigma_px": 0.1}
    refused = client.post(URL, json=body(points=points))
    assert refused.status_code == 422
    assert refused.json()["type"] == "/problems/invalid-parameter"
    assert "1 of 40 readings" in refused.json()["detail"]


def test_activation_moves_the_pointer_writes_history_and_reaches_the_live_side(
    client: Any, live: Any
):
    made = client.post(URL, json=body(id="second")).json()
    activated = client.post(f"{URL}/second/activate").json()
    assert activated["state"] == "active"
    assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "second"
    assert client.get(f"{URL}/sim-nominal").json()["state"] == "available"
    kind, device, calibration_id, calibration = live.calls[-1]
    assert (kind, device, calibration_id) == ("calibration", "sim", "second")
    assert calibration == TypeAdapter(Calibration).validate_python(made["result"])

    client.post(f"{URL}/sim-nominal/activate")
    history = client.get("/api/v1/devices/sim/activations").json()
    assert [
        (item["calibration_id"], item["previous_calibration_id"]) for item in history["items"]
    ] == [("sim-nominal", "second"), ("second", "sim-nominal"), ("sim-nominal", None)]
    assert len(history["items"]) == 3


def test_activating_the_active_one_writes_no_history(client: Any):
    assert client.post(f"{URL}/sim-nominal/activate").status_code == 200
    assert len(client.get("/api/v1/devices/sim/activations").json()["items"]) == 1


@pytest.mark.slow
def test_retiring(client: Any):
    client.post(URL, json=body(id="second"))
    refused = client.post(f"{URL}/sim-nominal/retire")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-active")
    retired = client.post(f"{URL}/second/retire").json()
    assert retired["state"] == "retired"
    assert client.post(f"{URL}/second/retire").json() == retired
    refused = client.post(f"{URL}/second/activate")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-retired")
    assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "sim-nominal"


@pytest.mark.slow
def test_filters_and_pages(client: Any):
    for name in ("a", "b", "c"):
        client.post(URL, json=body(id=name))
    client.post(f"{URL}/b/retire")

    def ids(query: str) -> list[str]:
        return [item["id"] for item in client.get(f"{URL}?{query}").json()["items"]]

    assert ids("state=active") == ["sim-nominal"]
    assert ids("state=retired") == ["b"]
    assert ids("state=available&device_id=sim") == ["c", "a"]
    assert ids("device_id=other") == []
    assert ids("limit=2") == ["c", "b"]


@pytest.mark.parametrize("method", ["PUT", "PATCH"])
def test_calibrations_are_immutable(client: Any, method: str):
    before = client.get(f"{URL}/sim-nominal").json()
    refused = client.request(method, f"{URL}/sim-nominal", json=body())
    assert refused.status_code == 405
    assert refused.headers["allow"] == "DELETE, GET, HEAD"
    assert client.get(f"{URL}/sim-nominal").json() == before


def test_an_id_is_never_overwritten(client: Any):
    refused = client.post(URL, json=body(id="sim-nominal"))
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-exists")


def test_the_seeded_calibration_says_that_nothing_was_measured(client: Any):
    document = client.get(f"{URL}/sim-nominal").json()
    assert document["provenance"] == "nominal"
    assert document["points"] == []
    assert set(document["errors"].values()) == {None}
