"""Locations of errors: the path to the value in the body that was sent."""

from typing import Any

import pytest

from service.problems.field_errors import location_in_body

SENSORS = [{"name": "a", "pixels": 8, "pitch_um": 7.0}, {"pixels": 1}]


def external(**more: Any) -> dict[str, Any]:
    return {"id": "b", "title": "B", "source": {"kind": "external", "sensors": SENSORS} | more}


def locations(answer: Any) -> list[list[str | int]]:
    assert answer.status_code == 422
    return [item["location"] for item in answer.json()["errors"]]


def test_the_kind_of_a_source_is_not_part_of_the_path(sqlite_client: Any):
    found = locations(sqlite_client.post("/api/v1/devices", json=external()))
    assert found == [
        ["body", "source", "sensors", 1, "name"],
        ["body", "source", "sensors", 1, "pixels"],
        ["body", "source", "sensors", 1, "pitch_um"],
    ]


def test_a_key_of_the_same_name_is(sqlite_client: Any):
    body = external(external={"sensors": 3})
    found = locations(sqlite_client.post("/api/v1/devices", json=body))
    assert ["body", "source", "external"] in found
    assert ["body", "source", "sensors", 1, "name"] in found


def test_unions_inside_unions(sqlite_client: Any):
    scene = {"kind": "rotating-bar", "length_mm": "long"}
    source = {"kind": "simulated", "settings": {"scene": scene, "bits": 99}}
    body = {"id": "b", "title": "B", "source": source}
    assert locations(sqlite_client.post("/api/v1/devices", json=body)) == [
        ["body", "source", "settings", "scene", "length_mm"],
        ["body", "source", "settings", "bits"],
    ]


def test_readings(sqlite_client: Any):
    readings = {"v": "x", "w": {"position_px": "y"}, "position": {"sigma_px": 0}}
    points = [{"name": "a", "position_mm": [1, 2], "readings": readings}]
    body = {"device_id": "sim", "points": points}
    at = ["body", "points", 0]
    assert locations(sqlite_client.post("/api/v1/calibrations", json=body)) == [
        [*at, "position_mm", 2],
        [*at, "readings", "v"],
        [*at, "readings", "w", "position_px"],
        [*at, "readings", "w", "sigma_px"],
        [*at, "readings", "position", "position_px"],
        [*at, "readings", "position", "sigma_px"],
    ]


@pytest.mark.parametrize("content", [b"", b"3"])
def test_a_body_that_is_missing_or_no_object(sqlite_client: Any, content: bytes):
    headers = {"content-type": "application/json"}
    answer = sqlite_client.post("/api/v1/devices", content=content, headers=headers)
    assert locations(answer) == [["body"]]


def test_a_query_keeps_its_location(sqlite_client: Any):
    assert locations(sqlite_client.get("/api/v1/devices?limit=0")) == [["query", "limit"]]


@pytest.mark.parametrize("parts", [["a", 3, "b"], ["a", 0]])
def test_what_does_not_lead_through_the_body_stays(parts: list[str | int]):
    assert location_in_body(parts, {"a": []}, missing=False) == parts


def test_a_member_with_the_name_of_a_key_does_not_hide_what_lies_beside_it() -> None:
    """A source of kind "profile" with a field "profile", which is a text."""
    body = {"source": {"kind": "profile", "profile": "bar", "settings": {"frame_rate_hz": -1}}}
    location = ("source", "profile", "settings", "frame_rate_hz")
    found = location_in_body(location, body, missing=False)
    assert found == ["source", "settings", "frame_rate_hz"]
    named = location_in_body(("source", "profile", "profile"), body, missing=False)
    assert named == ["source", "profile"]


def test_a_body_whose_kind_is_also_one_of_its_keys(sqlite_client: Any):
    places = [[0.0, 0.0, 0.0]] * 12
    body = {
        "id": "skin", "kind": "surface", "device_id": "sim", "parent_id": "ct", "points_mm": places,
        "surface": {"kind": "points", "points_mm": places},
    }  # fmt: skip
    more = {"trim": 0.5, "reference_id": "pointer"}
    for changes, expected in (
        (more, [["trim"], ["reference_id"]]),
        ({"surface": {"kind": "points", "points": 3}},
         [["surface", "points_mm"], ["surface", "points"]]),
        ({"surface": {"kind": "mesh", "vertices_mm": [[0.0, 0.0, "x"]] * 3, "triangles": []}},
         [["surface", "vertices_mm", 0, 2], ["surface", "triangles"]]),
        ({"surface": {"kind": "skin"}}, [["surface"]]),
        ({"surface": 3, "points_mm": [[0.0]]},
         [["points_mm", 0, 1], ["points_mm", 0, 2], ["surface"]]),
    ):  # fmt: skip
        answer = sqlite_client.post("/api/v1/registrations", json=body | changes)
        found = locations(answer)
        assert sorted(found, key=str) == sorted((["body", *one] for one in expected), key=str)
    without = {name: value for name, value in body.items() if name not in ("surface", "parent_id")}
    answer = sqlite_client.post("/api/v1/registrations", json=without)
    assert locations(answer) == [["body", "parent_id"], ["body", "surface"]]
