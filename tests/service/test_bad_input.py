"""Walks the table of docs/reference/bad-input.md: sends every row; nothing may be stored."""

import copy
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from service.api.calibrations.calibration_content import calibration_content, content_hash
from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.correction_tables.hdf5_file import write_table
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.api.drift_checks.examples import NEW_DRIFT_CHECKS
from service.api.paging import Paging
from service.api.reconstructions.examples import NEW_RECONSTRUCTIONS
from service.api.runs.examples import NEW_MAPPING_RUNS, NEW_SELF_CALIBRATION_RUNS, NEW_UPDATE_RUNS
from service.api.wave_captures.examples import NEW_WAVE_CAPTURES
from service.application.app import create_app
from service.application.initial_content import nominal_calibration
from service.database.models import Base
from service.problems.catalogue import PROBLEM_TYPES
from service.settings import Settings
from tests.service.api.correction_tables import test_hdf5_file as hdf5_files
from tests.service.api.correction_tables.tables import content
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.renamed_profiles import renamed_profile

TABLE = Path(__file__).parents[2] / "docs" / "reference" / "bad-input.md"
BODY_LIMIT_BYTES = 65536
TABLE_LIMIT_BYTES = 262144
Json = Any


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    what: str
    request: str
    status: int
    kind: str
    words: list[str]


@dataclass(frozen=True)
class Sent:
    """One request."""

    method: str
    path: str
    body: Json = None
    content: bytes | None = None
    headers: dict[str, str | None] = field(default_factory=dict)


def rows() -> list[Row]:
    found = []
    for line in TABLE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[2].isdecimal():
            what, request, status, kind, words = cells
            found.append(Row(what, request, int(status), kind, words.split("; ")))
    return found


BUILDERS: dict[str, Callable[[], Sent]] = {}


def builds(what: str) -> Callable[[Callable[[], Sent]], Callable[[], Sent]]:
    def register(builder: Callable[[], Sent]) -> Callable[[], Sent]:
        assert what not in BUILDERS, what
        BUILDERS[what] = builder
        return builder

    return register


def calibration(**changes: Any) -> Json:
    body = copy.deepcopy(NEW_CALIBRATIONS["frame"]["value"]) | changes
    del body["id"]
    return body


def reconstruction(**changes: Any) -> Json:
    body = copy.deepcopy(NEW_RECONSTRUCTIONS["check"]["value"]) | changes
    del body["id"]
    return body


def post_calibration(body: Json) -> Sent:
    return Sent("POST", "/api/v1/calibrations", body)


def post_reconstruction(body: Json) -> Sent:
    return Sent("POST", "/api/v1/reconstructions", body)


def external(**changes: Any) -> Json:
    sensors = [{"name": name, "pixels": 2048, "pitch_um": 14.0} for name in "ABCD"]
    source = {"kind": "external", "sensors": sensors}
    return {"id": "other", "title": "Other", "source": source} | changes


def post_device(body: Json) -> Sent:
    return Sent("POST", "/api/v1/devices", body)


def simulated(settings: Json) -> Sent:
    source = {"kind": "simulated", "settings": settings}
    return post_device({"id": "other", "title": "Other", "source": source})


def raw(content: bytes, media_type: str = "application/json") -> Sent:
    path = "/api/v1/calibrations"
    return Sent("POST", path, content=content, headers={"content-type": media_type})


def with_coordinate(literal: str) -> Sent:
    body = calibration()
    body["points"][0]["position_mm"][1] = "HERE"
    return raw(json.dumps(body).replace('"HERE"', literal).encode())


def with_reading(body: Json, sensor: str, value: Json) -> Json:
    body["points"][0]["readings"][sensor] = value
    return body


def same_name(body: Json) -> Json:
    for point in body["points"][:2]:
        point["name"] = "same"
    return body


@builds("too few points")
def _() -> Sent:
    body = calibration()
    body["points"] = body["points"][:6]
    return post_calibration(body)


@builds("no point")
def _() -> Sent:
    return post_calibration(calibration(points=[]))


@builds("coplanar points")
def _() -> Sent:
    body = calibration()
    for point in body["points"]:
        point["position_mm"][2] = 1500.0
    return post_calibration(body)


builds("NaN as a coordinate")(lambda: with_coordinate("NaN"))
builds("Infinity as a coordinate")(lambda: with_coordinate("Infinity"))
builds("1e999 as a coordinate")(lambda: with_coordinate("1e999"))
builds("a coordinate too large")(lambda: with_coordinate("1e9"))
builds("number as text")(lambda: with_coordinate('"10"'))


@builds("NaN as a reading")
def _() -> Sent:
    return raw(json.dumps(with_reading(calibration(), "vertical", float("nan"))).encode())


@builds("NaN as a reading to reconstruct")
def _() -> Sent:
    content = json.dumps(with_reading(reconstruction(), "vertical", float("nan"))).encode()
    headers = {"content-type": "application/json"}
    return Sent("POST", "/api/v1/reconstructions", content=content, headers=headers)


def with_column(sensor: str, values: Callable[[int, dict[str, float]], float]) -> Json:
    body = calibration()
    for index, point in enumerate(body["points"]):
        point["readings"][sensor] = values(index, point["readings"])
    return body


@builds("readings that have nothing to do with the points")
def _() -> Sent:
    drawn = np.random.default_rng(5).uniform(0.0, 2047.0, 19).round(2).tolist()
    return post_calibration(with_column("vertical", lambda index, _: drawn[index]))


@builds("0 entered for markers that were not seen")
def _() -> Sent:
    body = with_column("vertical", lambda index, own: 0.0 if index < 2 else own["vertical"])
    return post_calibration(body)


def copied() -> Json:
    return with_column("horizontal", lambda _, own: own["vertical"])


builds("readings of one sensor copied to another")(lambda: post_calibration(copied()))
builds("readings of one sensor copied to another for a run")(
    lambda: Sent("POST", "/api/v1/runs/calibration", copied())
)
builds("always the same reading")(lambda: post_calibration(with_column("vertical", lambda *_: 5.0)))


@builds("unknown sensor")
def _() -> Sent:
    return post_calibration(with_reading(calibration(), "sixth", 3.0))


@builds("unknown sensor to reconstruct")
def _() -> Sent:
    return post_reconstruction(with_reading(reconstruction(), "sixth", 3.0))


builds("point name given twice")(lambda: post_calibration(same_name(calibration())))
builds("point name given twice to reconstruct")(
    lambda: post_reconstruction(same_name(reconstruction()))
)


@builds("point position given twice")
def _() -> Sent:
    body = calibration()
    body["points"][1]["position_mm"] = body["points"][0]["position_mm"]
    return post_calibration(body)


@builds("reading of one sensor given twice")
def _() -> Sent:
    text = json.dumps(reconstruction()).replace(
        '"readings": {', '"readings": {"vertical": 5.0, ', 1
    )
    headers = {"content-type": "application/json"}
    return Sent("POST", "/api/v1/reconstructions", content=text.encode(), headers=headers)


@builds("reading above the last pixel")
def _() -> Sent:
    return post_calibration(with_reading(calibration(), "vertical", 2047.6))


@builds("reading below the first pixel")
def _() -> Sent:
    return post_reconstruction(with_reading(reconstruction(), "vertical", -0.6))


@builds("standard deviations for some readings only")
def _() -> Sent:
    weighted = {"position_px": 1000.0, "sigma_px": 0.1}
    return post_calibration(with_reading(calibration(), "vertical", weighted))


@builds("standard deviation of zero")
def _() -> Sent:
    weighted = {"position_px": 1000.0, "sigma_px": 0.0}
    return post_reconstruction(with_reading(reconstruction(), "vertical", weighted))


@builds("calibration of another device")
def _() -> Sent:
    points = [{"name": "P", "readings": {"A": 1.0, "B": 2.0, "C": 3.0}}]
    return post_reconstruction(
        {"device_id": "bar", "calibration_id": "sim-nominal", "points": points}
    )


builds("unknown calibration")(lambda: post_reconstruction(reconstruction(calibration_id="nothing")))
builds("retired calibration")(lambda: post_reconstruction(reconstruction(calibration_id="old")))
builds("device without active calibration")(
    lambda: post_reconstruction(reconstruction(device_id="bar"))
)
builds("empty list of points")(lambda: post_reconstruction(reconstruction(points=[])))
builds("unknown device")(lambda: post_calibration(calibration(device_id="nothing")))
builds("unknown device to reconstruct")(
    lambda: post_reconstruction(reconstruction(device_id="nothing"))
)
builds("calibration id taken")(lambda: post_calibration(calibration() | {"id": "sim-nominal"}))
builds("body not JSON")(lambda: raw(b"points=3"))
builds("body cut short")(lambda: raw(b'{"device_id": "sim"'))
builds("body not UTF-8")(lambda: raw(b'{"device_id": "\xff\xfe"}'))
builds("body nested too deeply")(lambda: raw(b"[" * 30_000))
builds("no body")(lambda: Sent("POST", "/api/v1/calibrations"))
builds("body declared as a form")(lambda: raw(b"points=3", "application/x-www-form-urlencoded"))
builds("body too large")(lambda: post_calibration(calibration(note="x" * BODY_LIMIT_BYTES)))
builds("unknown field")(lambda: post_calibration(calibration(colour="red")))


@builds("half a surrogate pair")
def _() -> Sent:
    content = json.dumps(external(title="\ud800")).encode()
    headers = {"content-type": "application/json"}
    return Sent("POST", "/api/v1/devices", content=content, headers=headers)


@builds("unknown field inside a point")
def _() -> Sent:
    body = calibration()
    body["points"][0]["colour"] = "red"
    return post_calibration(body)


builds("unknown field of the simulator")(lambda: simulated({"colour": "red"}))


@builds("missing field")
def _() -> Sent:
    body = calibration()
    del body["device_id"]
    return post_calibration(body)


@builds("truth value as number")
def _() -> Sent:
    body = external()
    body["source"]["sensors"][0]["pixels"] = True
    return post_device(body)


builds("body is a list")(lambda: post_calibration([]))


@builds("position of two numbers")
def _() -> Sent:
    body = calibration()
    body["points"][0]["position_mm"].pop()
    return post_calibration(body)


builds("device id with capitals")(lambda: post_device(external(id="Bar 1")))
builds("device id taken")(lambda: post_device(external(id="sim")))
builds("unknown kind of device")(lambda: post_device(external(source={"kind": "camera"})))
builds("setting of the simulator out of bounds")(lambda: simulated({"bits": 17}))
builds("scene that cannot be")(
    lambda: simulated({"scene": {"kind": "rotating-bar", "plane_normal": [0, 0, 0]}})
)


@builds("two sensors of one name")
def _() -> Sent:
    body = external()
    body["source"]["sensors"][1]["name"] = "A"
    return post_device(body)


def replay(name: str) -> Sent:
    return post_device(external(source={"kind": "replay", "recording_id": name}))


builds("unknown recording")(lambda: replay("none.h5"))
builds("recording outside the folder")(lambda: replay("../lumiline.sqlite3"))


def of_profile(profile: str, **settings: Json) -> Json:
    return {"kind": "profile", "profile_id": profile, "settings": settings}


builds("unknown profile of a device")(lambda: post_device(external(source=of_profile("nothing"))))
builds("profile outside the folder")(lambda: post_device(external(source=of_profile("../broken"))))
builds("device of a broken profile")(lambda: post_device(external(source=of_profile("broken"))))
builds("faster than the profile's device")(
    lambda: post_device(external(source=of_profile("thesis-5.9", frame_rate_hz=31)))
)
builds("unknown optics of a profile's device")(
    lambda: post_device(external(source=of_profile("bar", optics="perfect")))
)
builds("unknown field of a profile's device")(
    lambda: post_device(external(source=of_profile("bar", bits=12)))
)
builds("changed to an unknown profile")(
    lambda: Sent("PATCH", "/api/v1/devices/bar", {"source": of_profile("nothing")})
)
builds("changed to be faster than its profile's device")(
    lambda: Sent("PATCH", "/api/v1/devices/bar", {"source": of_profile("bar", frame_rate_hz=9999)})
)
builds("title emptied")(lambda: Sent("PATCH", "/api/v1/devices/sim", {"title": ""}))
builds("other sensors under calibrations")(
    lambda: Sent("PATCH", "/api/v1/devices/sim", {"source": external()["source"]})
)
builds("other sensors of a running device")(
    lambda: Sent("PATCH", "/api/v1/devices/running", {"source": external()["source"]})
)
builds("changed without saying what was read")(
    lambda: Sent("PATCH", "/api/v1/devices/sim", {"title": "New"}, headers={"If-Match": None})
)
builds("changed after somebody else did")(
    lambda: Sent("PATCH", "/api/v1/devices/sim", {"title": "New"}, headers={"If-Match": '"0123"'})
)
builds("ETag without its quotes")(
    lambda: Sent("PATCH", "/api/v1/devices/sim", {"title": "New"}, headers={"If-Match": "0123"})
)
builds("unknown device changed")(lambda: Sent("PATCH", "/api/v1/devices/nothing", {"title": "New"}))
builds("external device started")(lambda: Sent("POST", "/api/v1/devices/bar/start"))
builds("unknown device started")(lambda: Sent("POST", "/api/v1/devices/nothing/start"))
builds("device with calibrations deleted")(lambda: Sent("DELETE", "/api/v1/devices/sim"))
builds("active calibration retired")(
    lambda: Sent("POST", "/api/v1/calibrations/sim-nominal/retire")
)
builds("retired calibration activated")(lambda: Sent("POST", "/api/v1/calibrations/old/activate"))
builds("unknown calibration activated")(
    lambda: Sent("POST", "/api/v1/calibrations/nothing/activate")
)
builds("calibration changed")(
    lambda: Sent("PUT", "/api/v1/calibrations/sim-nominal", calibration())
)
builds("used calibration deleted")(lambda: Sent("DELETE", "/api/v1/calibrations/sim-nominal"))
builds("unknown path")(lambda: Sent("GET", "/api/v1/cameras"))
builds("page size out of bounds")(lambda: Sent("GET", "/api/v1/calibrations?limit=1000"))
builds("cursor that is none")(lambda: Sent("GET", "/api/v1/calibrations?cursor=abc"))
builds("unknown name in the query")(lambda: Sent("GET", "/api/v1/calibrations?device=sim"))


@builds("cursor of another list")
def _() -> Sent:
    cursor = Paging(1, None, "another").cursor(["2024-02-29T12:00:00+00:00", "sim-nominal"])
    return Sent("GET", f"/api/v1/calibrations?cursor={cursor}")


builds("unknown state")(lambda: Sent("GET", "/api/v1/calibrations?state=broken"))
builds("unknown reconstruction")(lambda: Sent("GET", "/api/v1/reconstructions/nothing"))
builds("unknown device profile")(lambda: Sent("GET", "/api/v1/device-profiles/nothing"))
builds("broken device profile")(lambda: Sent("GET", "/api/v1/device-profiles/broken"))
builds("plan of a broken device profile")(
    lambda: Sent("GET", "/api/v1/device-profiles/broken/plan")
)
builds("plan of an unknown device profile")(
    lambda: Sent("GET", "/api/v1/device-profiles/nothing/plan")
)
builds("picture of an unknown device profile")(
    lambda: Sent("GET", "/api/v1/device-profiles/nothing/plan.png")
)
builds("grid of a plan too coarse")(lambda: Sent("GET", "/api/v1/device-profiles/bar/plan?grid=2"))
builds("grid of a plan too fine")(lambda: Sent("GET", "/api/v1/device-profiles/bar/plan?grid=50"))
builds("grid of a picture no number")(
    lambda: Sent("GET", "/api/v1/device-profiles/bar/plan.png?grid=fine")
)
builds("unknown problem type")(lambda: Sent("GET", "/problems/nothing"))


def post_run(**changes: Any) -> Sent:
    body = calibration() | {"result_id": None} | changes
    return Sent("POST", "/api/v1/runs/calibration", body)


def post_mapping(**changes: Any) -> Sent:
    body = copy.deepcopy(NEW_MAPPING_RUNS["grid"]["value"]) | {"id": None} | changes
    return Sent("POST", "/api/v1/runs/mapping", body)


def post_drift_check(calibration_id: str = "sim-nominal", **changes: Any) -> Sent:
    body = copy.deepcopy(NEW_DRIFT_CHECKS["frame"]["value"]) | {"id": None} | changes
    return Sent("POST", f"/api/v1/calibrations/{calibration_id}/drift-checks", body)


def post_update(**changes: Any) -> Sent:
    body = copy.deepcopy(NEW_UPDATE_RUNS["frame"]["value"]) | {"id": None} | changes
    return Sent("POST", "/api/v1/runs/update", body)


def still(**changes: Any) -> list[Json]:
    points = copy.deepcopy(NEW_DRIFT_CHECKS["frame"]["value"]["points"])
    points[0] = {name: value for name, value in (points[0] | changes).items() if value is not None}
    return points


builds("drift check without positions")(lambda: post_drift_check(points=still(position_mm=None)))
builds("drift check against nothing earlier")(
    lambda: post_drift_check(points=still(name="elsewhere"), against="calibration")
)
builds("drift check of too many markers")(lambda: post_drift_check(points=still() * 26))
builds("drift check of an unknown calibration")(lambda: post_drift_check("nothing"))
builds("drift check read by an unknown sensor")(
    lambda: post_drift_check(points=still(readings={"sixth": 1.0}))
)
builds("unknown drift check")(lambda: Sent("GET", "/api/v1/drift-checks/nothing"))
builds("update by nothing")(lambda: post_update(points=None))
builds("update by an unknown drift check")(
    lambda: Sent("POST", "/api/v1/runs/update", {"device_id": "sim", "drift_check_id": "nothing"})
)
builds("update of what no camera has")(lambda: post_update(allowance={"colour": 1.0}))
builds("update of a calibration of another device")(lambda: post_update(device_id="bar"))


def upload(data: bytes, query: str = "", media_type: str = MEDIA_TYPE) -> Sent:
    path = f"/api/v1/correction-tables{query}"
    return Sent("POST", path, content=data, headers={"content-type": media_type})


def table(change: Callable[[Any], Any] | None = None, **arrays: Any) -> bytes:
    data = write_table(content("ab" * 32, **arrays))
    if change is None:
        return data
    with hdf5_files.changed(data) as (file, after):
        change(file)
    return after[0]


def with_nan(file: Any) -> None:
    file["coefficients_px"][1, 2, 0, 0] = float("nan")


def wrong_shape(file: Any) -> None:
    hdf5_files.replace(file, "variance_px2", data=np.zeros((4, 6, 5, 5)))


def without_valid_cells() -> bytes:
    valid = np.ones((4, 5, 4, 3), dtype=np.bool_)
    valid[2] = False
    return table(valid=valid)


def flat(points: Json) -> Json:
    for point in points:
        point["position_mm"][2] = 1500.0
    return points


builds("neither points nor a capture for a run")(lambda: post_run(points=None))
builds("both points and a capture for a run")(lambda: post_run(capture_id="begun"))
builds("coplanar points for a run")(lambda: post_run(points=flat(calibration()["points"])))
builds("distortion of too high an order")(lambda: post_run(distortion=[[3, 0], [50, 50]]))
builds("unknown distortion")(lambda: post_run(distortion="everything"))
builds("result id of a run taken")(lambda: post_run(result_id="sim-nominal"))
builds("capture of nothing for a run")(lambda: post_run(points=None, capture_id="nothing"))
builds("capture with targets left for a run")(
    lambda: post_run(points=None, capture_id="begun", device_id="bar")
)
builds("unknown run")(lambda: Sent("GET", "/api/v1/runs/nothing"))
builds("unknown run cancelled")(lambda: Sent("POST", "/api/v1/runs/nothing/cancel"))
builds("unknown state of runs")(lambda: Sent("GET", "/api/v1/runs?state=broken"))


@builds("too few points to map")
def _() -> Sent:
    return post_mapping(points=NEW_MAPPING_RUNS["grid"]["value"]["points"][::18])


@builds("points to map in one plane")
def _() -> Sent:
    return post_mapping(points=flat(copy.deepcopy(NEW_MAPPING_RUNS["grid"]["value"]["points"])))


builds("map for a calibration of another device")(lambda: post_mapping(device_id="bar"))
builds("map for a retired calibration")(lambda: post_mapping(calibration_id="old"))
builds("pitch of a map too fine")(lambda: post_mapping(pitch_mm=[0.001] * 3))
builds("pitch of a map through every value")(
    lambda: post_mapping(method="trilinear", pitch_mm=[10, 10, 10])
)


def post_wand(**changes: Any) -> Sent:
    body = copy.deepcopy(NEW_SELF_CALIBRATION_RUNS["wand"]["value"]) | {"id": None} | changes
    return Sent("POST", "/api/v1/runs/self-calibration", body)


def post_wave(**changes: Any) -> Sent:
    body = NEW_WAVE_CAPTURES["wand"]["value"] | {"id": None} | changes
    return Sent("POST", "/api/v1/wave-captures", body)


@builds("wand with one marker")
def _() -> Sent:
    sent = post_wand()
    [recording] = sent.body["recordings"]
    recording["target"]["position_mm"] = [0.0]
    recording["poses"] = [{name: pair[:1] for name, pair in pose.items()}
                          for pose in recording["poses"]]  # fmt: skip
    return sent


@builds("wand read by an unknown sensor")
def _() -> Sent:
    sent = post_wand()
    sent.body["recordings"][0]["poses"][0]["sixth"] = [1.0, 2.0]
    return sent


builds("self-calibration from another device's start")(
    lambda: post_wand(start_calibration_id="of-bar")
)
builds("self-calibration from no wand and no session")(lambda: post_wand(recordings=None))
builds("self-calibration from a session that there is none of")(
    lambda: post_wand(recordings=None, wave_capture_id="nothing")
)


@builds("self-calibration from sigmas of fewer poses")
def _() -> Sent:
    sent = post_wand()
    sent.body["recordings"][0]["sigma_px"] = sent.body["recordings"][0]["poses"][:1]
    return sent


builds("waved wand with one marker")(
    lambda: post_wave(target={"kind": "wand", "position_mm": [0.0]})
)
builds("waved wand with more strobed markers than its own")(lambda: post_wave(markers=[0, 1, 2]))
builds("waved wand of an unknown device")(lambda: post_wave(device_id="nothing"))
builds("waved wand that is not there")(lambda: Sent("POST", "/api/v1/wave-captures/nothing/start"))
builds("table that is not HDF5")(lambda: upload(b"points=3"))
builds("table cut short")(lambda: upload(table()[:3000]))
builds("table declared as JSON")(lambda: upload(table(), media_type="application/json"))
builds("table that is a decompression bomb")(lambda: upload(table(small_bomb)))
builds("table that declares terabytes")(lambda: upload(table(hdf5_files.huge)))
builds("table with a link to another file")(lambda: upload(table(hdf5_files.external_link)))
builds("table with data in another file")(lambda: upload(table(hdf5_files.external_data)))
builds("table with virtual data")(lambda: upload(table(hdf5_files.virtual_data)))
builds("table with NaN")(lambda: upload(table(with_nan)))
builds("table of the wrong shape")(lambda: upload(table(wrong_shape)))
builds("table without valid cells of a sensor")(lambda: upload(without_valid_cells()))
builds("table of another calibration")(lambda: upload(table()))


@builds("table of another device than its calibration")
def _() -> Sent:
    nominal = content_hash(calibration_content("sim", "nominal", [], nominal_calibration()))
    return upload(write_table(replace(content(nominal), device="elsewhere")))


builds("table changed after it was written")(lambda: upload(table(hdf5_files.other_values)))
builds("table too large")(lambda: upload(bytes(TABLE_LIMIT_BYTES + 1)))
builds("table id taken")(lambda: upload(table(), "?id=foreign"))
builds("table of a calibration that is not active")(
    lambda: Sent("POST", "/api/v1/correction-tables/foreign/activate")
)
builds("unknown table activated")(
    lambda: Sent("POST", "/api/v1/correction-tables/nothing/activate")
)
builds("unknown table")(lambda: Sent("GET", "/api/v1/correction-tables/nothing"))
for kind, path in (("table", "correction-tables"), ("run", "runs"), ("capture", "captures")):
    builds(f"unknown {kind} deleted")(partial(Sent, "DELETE", f"/api/v1/{path}/nothing"))
builds("nothing to roll back to")(lambda: Sent("POST", "/api/v1/devices/bar/roll-back"))
builds("calibrations of two devices compared")(
    lambda: Sent("GET", "/api/v1/calibrations/sim-nominal/compare/of-bar")
)
builds("report of nothing")(lambda: Sent("GET", "/api/v1/calibrations/nothing/report.html"))
builds("unknown figure of a report")(
    lambda: Sent("GET", "/api/v1/calibrations/sim-nominal/report/pie.png")
)
builds("figure that a report has not")(
    lambda: Sent("GET", "/api/v1/calibrations/sim-nominal/report/coverage.png")
)


def post_capture(**changes: Any) -> Sent:
    target = {"name": "P1", "position_mm": [0.0, 0.0, 1500.0]}
    body = {"id": "begun", "device_id": "bar", "targets": [target]} | changes
    return Sent("POST", "/api/v1/captures", body)


builds("capture of targets with one name")(
    lambda: post_capture(id="twice", targets=[{"name": "P1", "position_mm": [0, 0, 1500]}] * 2)
)
builds("capture of targets at one place")(
    lambda: post_capture(
        id="same", targets=[{"name": name, "position_mm": [0, 0, 1500]} for name in ("P1", "Q")]
    )
)
builds("capture without targets")(lambda: post_capture(id="none", targets=[]))
builds("capture id taken")(post_capture)
builds("capture of a device that does not run")(
    lambda: Sent("POST", "/api/v1/captures/begun/capture")
)
builds("unknown target captured")(lambda: Sent("POST", "/api/v1/captures/begun/capture?target=P9"))
builds("unknown capture")(lambda: Sent("GET", "/api/v1/captures/nothing"))


def small_bomb(file: Any) -> None:
    hdf5_files.bomb(file, 16)


@pytest.fixture(scope="module")
def bad_input_client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A server with an external device "bar", a running one, a retired calibration of "sim".

    In its folder of profiles is one with a mistake, "broken".
    """
    data_dir = tmp_path_factory.mktemp("bad-input")
    settings = Settings(
        data_dir=data_dir,
        body_limit_bytes=BODY_LIMIT_BYTES,
        table_limit_bytes=TABLE_LIMIT_BYTES,
    )
    app = create_app(settings, FakePipeline())
    settings.folders.profiles.mkdir()
    (settings.folders.profiles / "broken.toml").write_text(
        renamed_profile("broken").replace('pitch = "14 um"', 'pitch = "14"'), "utf-8"
    )
    with TestClient(app, raise_server_exceptions=False) as client:
        for sent in (
            post_device(external(id="bar")),
            post_device({"id": "running", "title": "Running", "source": {"kind": "simulated"}}),
            Sent("POST", "/api/v1/devices/running/start"),
            post_calibration(calibration() | {"id": "old"}),
            Sent("POST", "/api/v1/calibrations/old/retire"),
        ):
            assert send(client, sent).is_success
        retired = client.get("/api/v1/calibrations/old").json()["content_hash"]
        foreign = write_table(content(retired))
        of_bar = calibration(device_id="bar") | {"id": "of-bar"}
        for point in of_bar["points"]:
            values = list(point["readings"].values())
            point["readings"] = dict(zip("ABCD", values, strict=True))
        for sent in (upload(foreign, "?id=foreign"), post_calibration(of_bar), post_capture()):
            assert send(client, sent).is_success
        yield client


def send(client: Any, sent: Sent) -> Any:
    given: dict[str, Any] = {"headers": sent.headers}
    if sent.content is not None:
        given["content"] = sent.content
    elif sent.body is not None:
        given["json"] = sent.body
    return client.request(sent.method, sent.path, **given)


def everything(client: Any) -> dict[str, list[str]]:
    """All rows of all tables but the audit log, which keeps what was refused."""
    with client.app.state.database.engine.connect() as connection:
        return {
            table.name: sorted(map(repr, connection.execute(select(table)).all()))
            for table in Base.metadata.sorted_tables
            if table.name != "audit_log"
        }


def test_every_row_has_a_builder_and_every_builder_a_row():
    names = [row.what for row in rows()]
    assert len(names) == len(set(names))
    assert set(names) == set(BUILDERS)


@pytest.mark.slow
@pytest.mark.parametrize("row", rows(), ids=lambda row: re.sub(r"\W+", "-", row.what))
def test_bad_input(bad_input_client: Any, row: Row):
    before = everything(bad_input_client)
    sent = BUILDERS[row.what]()
    answer = send(bad_input_client, sent)
    problem = answer.json()
    assert answer.status_code == row.status, problem
    assert answer.headers["content-type"] == "application/problem+json"
    assert problem["type"] == f"/problems/{row.kind}"
    assert problem["status"] == row.status
    assert problem["title"] == PROBLEM_TYPES[row.kind].title
    assert problem["instance"] == sent.path.partition("?")[0]
    for word in row.words:
        assert word in problem["detail"]
    assert everything(bad_input_client) == before
    assert row.request.split()[0] == sent.method
    assert bad_input_client.get(problem["type"]).json()["status"] == row.status


@pytest.mark.slow
def test_an_unknown_distortion_is_told_once(bad_input_client: Any):
    problem = send(bad_input_client, BUILDERS["unknown distortion"]()).json()
    assert [error["location"] for error in problem["errors"]] == [["body", "distortion"]]
