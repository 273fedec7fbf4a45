"""Devices simulated from profiles over REST, and the one that the settings name."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, LumilineError
from compute.optics.profiles.profile_loader import load_profile, parse_profile, profile_names
from compute.optics.profiles.profile_optics import profile_optics
from compute.planning.cramer_rao import centroids
from hardware.simulated.profile_driver import readout_of
from service.api.calibrations import nominal_router
from service.api.calibrations import store as calibrations
from service.api.calibrations.calibration_content import content_hash, result_of
from service.api.devices.nominal_calibration import nominal_calibration, nominal_in_process
from service.api.devices.profiles import profile_text
from service.api.devices.store import devices
from service.application.app import create_app
from service.application.bootstrap import prepare
from service.application.profile_device import device_id
from service.database.engine import Database
from service.database.models import DeviceRow
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.renamed_profiles import LENS, WINDOW, renamed_profile

DEVICES = "/api/v1/devices"
PROFILES = "/api/v1/device-profiles"
NOMINAL = "/api/v1/nominal-calibrations"


def body(profile: str, identity: str = "made", **settings: Any) -> dict[str, Any]:
    source = {"kind": "profile", "profile_id": profile, "settings": settings}
    return {"id": identity, "title": "Made", "source": source}


def keep(settings: Settings, name: str, text: str) -> Path:
    settings.folders.profiles.mkdir(parents=True, exist_ok=True)
    path = settings.folders.profiles / f"{name}.toml"
    path.write_text(text, "utf-8")
    return path


# Sources of kind "profile"


@pytest.mark.parametrize("name", profile_names())
def test_every_built_in_profile_makes_a_device(sqlite_client: Any, name: str) -> None:
    made = sqlite_client.post(DEVICES, json=body(name))
    assert made.status_code == 201, made.text
    profile = load_profile(name)
    assert [one["name"] for one in made.json()["sensors"]] == [one.name for one in profile.sensors]
    assert {one["pixels"] for one in made.json()["sensors"]} == {profile.pixels.count}
    assert made.json()["active_calibration_id"] is None


def test_a_profile_device_is_created_changed_and_started(client: Any, live: FakePipeline) -> None:
    scene = {"kind": "still-points", "points_mm": [[0, 0, 3000]]}
    made = client.post(DEVICES, json=body(WINDOW, scene=scene, frame_rate_hz=20))
    assert made.status_code == 201, made.text
    assert made.json()["source"]["settings"]["scene"] == scene
    faster = body(WINDOW, frame_rate_hz=40)["source"]
    changed = client.patch(f"{DEVICES}/made", json={"source": faster}).json()
    assert changed["source"]["settings"]["frame_rate_hz"] == 40
    assert client.get(f"{DEVICES}/made").json() == changed
    assert client.post(f"{DEVICES}/made/start").json()["state"] == "running"
    assert live.calls[-1][:3] == ("start", "made", None)


def test_ones_own_profile_in_the_data_directory(sqlite_client: Any, sqlite_settings: Settings):
    own = renamed_profile("my.window")
    keep(sqlite_settings, "my.window", own)
    assert sqlite_client.post(DEVICES, json=body("my.window")).status_code == 201
    page = sqlite_client.get(PROFILES, params={"limit": 200}).json()
    listed = [one["id"] for one in page["items"]]
    assert listed == sorted([*profile_names(), "my.window"])
    read = sqlite_client.get(f"{PROFILES}/my.window")
    assert (read.status_code, read.json()["toml"]) == (200, own)


@pytest.mark.slow
def test_a_plan_is_of_the_file_as_it_is_now(sqlite_client: Any, sqlite_settings: Settings) -> None:
    text = renamed_profile("mine")
    keep(sqlite_settings, "mine", text)
    before = sqlite_client.get(f"{PROFILES}/mine/plan").json()
    keep(sqlite_settings, "mine", text.replace('"200 mW/sr"', '"20 mW/sr"'))
    after = sqlite_client.get(f"{PROFILES}/mine/plan").json()
    assert (before["profile_id"], after["profile_id"]) == ("mine", "mine")
    assert after["noise"]["centre"][2] > 1.5 * before["noise"]["centre"][2]


def test_what_is_no_profile_is_not_listed_and_says_why(
    sqlite_client: Any, sqlite_settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    keep(sqlite_settings, "broken", renamed_profile("broken").replace('"14 um"', "14"))
    keep(sqlite_settings, "other-name", renamed_profile("name"))
    keep(sqlite_settings, "bar", renamed_profile("bar"))  # the built-in one wins
    keep(sqlite_settings, "No Slug", renamed_profile("no-slug"))
    (sqlite_settings.folders.profiles / "latin.toml").write_bytes(b'name = "caf\xe9"')
    found = sqlite_client.get(PROFILES, params={"limit": 200}).json()["items"]
    assert [one["id"] for one in found] == list(profile_names())
    assert [one["sensor_count"] for one in found if one["id"] == "bar"] == [4]
    logged = caplog.text
    for name, part in (
        ("broken", "pixels.pitch"), ("other-name", '"name"'), ("latin", "cannot be read"),
    ):  # fmt: skip
        assert part in logged
        for refused in (
            sqlite_client.get(f"{PROFILES}/{name}"),
            sqlite_client.get(f"{PROFILES}/{name}/plan"),
            sqlite_client.get(f"{PROFILES}/{name}/plan.png"),
            sqlite_client.post(DEVICES, json=body(name)),
        ):
            assert (refused.status_code, refused.json()["type"]) == (
                422, "/problems/invalid-parameter",
            )  # fmt: skip
            assert part in refused.json()["detail"]


def test_a_profile_that_is_gone_fails_at_the_start(
    sqlite_client: Any, sqlite_settings: Settings
) -> None:
    path = keep(sqlite_settings, "mine", renamed_profile("mine"))
    assert sqlite_client.post(DEVICES, json=body("mine")).status_code == 201
    path.unlink()
    refused = sqlite_client.post(f"{DEVICES}/made/start")
    assert (refused.status_code, refused.json()["type"]) == (
        404, "/problems/unknown-device-profile",
    )  # fmt: skip


# The device that the settings name


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    found = Database(settings.effective_database_url)
    yield found
    found.close()


def named(settings: Settings, device: str | Path) -> Settings:
    return settings.model_copy(update={"profile": str(device)})


@pytest.fixture
def window(tmp_path: Path) -> Path:
    """A file with a profile of one's own, "window-1", outside of the data directory."""
    path = tmp_path / "anything.toml"
    path.write_text(renamed_profile("window-1"), "utf-8")
    return path


@pytest.mark.slow
def test_the_device_is_calibrated_stored_and_started(
    settings: Settings, database: Database, live: FakePipeline
) -> None:
    settings = named(settings, LENS)
    assert prepare(settings, database) == ("thesis-5-9",)
    with TestClient(create_app(settings, live)) as client:
        device = client.get(f"{DEVICES}/thesis-5-9").json()
        assert device["source"]["profile_id"] == LENS
        assert device["autostart"] is False
        assert device["active_calibration_id"] == "thesis-5-9-nominal"
        document = client.get("/api/v1/calibrations/thesis-5-9-nominal").json()
        assert document["provenance"] == "nominal"
        assert "nothing was measured" in document["note"]
        started = {call[1]: call[2] for call in live.calls if call[0] == "start"}
        assert started == {"sim": "sim-nominal", "thesis-5-9": "thesis-5-9-nominal"}

        # A user's own settings and calibrations are kept by the next start.
        slower = body(LENS, frame_rate_hz=10)["source"]
        client.patch(f"{DEVICES}/thesis-5-9", json={"source": slower})
        before = client.get(f"{DEVICES}/thesis-5-9").json()
    again = FakePipeline()
    with TestClient(create_app(settings, again)) as client:
        assert client.get(f"{DEVICES}/thesis-5-9").json() == before
        assert len(client.get("/api/v1/calibrations").json()["items"]) == 2
    assert ("start", "thesis-5-9", "thesis-5-9-nominal") in [call[:3] for call in again.calls]


def test_the_calibration_is_of_the_traced_optics() -> None:
    """It projects points that it never saw to within what it says of the lenses' distortion."""
    profile = load_profile(LENS)
    found = nominal_calibration(profile)
    share = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 3))
    points = profile.volume.centre_mm + share * profile.volume.size_mm
    solid_angles = profile_optics(profile, "exact").solid_angles(points)
    readings = centroids(solid_angles, profile.pixels.count)[0]
    error = CameraStack.of(found.models).project(points) - readings
    rms = np.sqrt((error**2).mean(axis=0))
    stated = np.array([fit.rms_px for fit in found.sensors])
    assert (rms < 1.5 * stated).all()
    assert (stated < 1.0).all()


def test_a_file_is_taken_into_the_data_directory_once(
    settings: Settings, database: Database, window: Path
) -> None:
    settings = named(settings, window)
    assert prepare(settings, database) == ("window-1",)
    kept = settings.folders.profiles / "window-1.toml"
    assert kept.read_bytes() == window.read_bytes()
    assert list(kept.parent.iterdir()) == [kept]
    assert prepare(settings, database) == ("window-1",)
    # From then on by its name, wherever the file was.
    window.unlink()
    assert prepare(named(settings, "window-1"), database) == ("window-1",)


GRAY = "mitchelson-1971"


def test_a_device_that_is_not_read_is_not_calibrated(
    settings: Settings, database: Database
) -> None:
    assert prepare(named(settings, GRAY), database) == (GRAY,)
    assert prepare(named(settings, WINDOW), database) == (WINDOW,)
    with database.read() as session:
        assert calibrations.active_id(session, GRAY) is None
        assert calibrations.active_id(session, WINDOW) == f"{WINDOW}-nominal"
        assert result_of(calibrations.get_calibration(session, "sim-nominal").content)


def refusal(settings: Settings, device: str | Path, database: Database) -> str:
    prepare(settings, database)
    before = stored(settings, database)
    with pytest.raises(InvalidParameter) as caught:
        prepare(named(settings, device), database)
    assert stored(settings, database) == before
    return caught.value.detail


def stored(settings: Settings, database: Database) -> tuple[list[str], list[str]]:
    with database.read() as session:
        stored_devices = [row.id for row in session.scalars(devices())]
    return stored_devices, sorted(str(path) for path in settings.folders.profiles.glob("*"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bar", "built-in"),
        ("Window 1", "lower case"),
        ("-window", "lower case"),
        ("", "not empty"),
        ("../window", "lower case"),
        ("w" * 56, "1 to 55"),
        ("sim", "simulated"),
        ("thesis-5-9", "there already"),
    ],
)
def test_a_name_that_cannot_be_the_devices(
    sqlite_settings: Settings, tmp_path: Path, name: str, words: str
) -> None:
    own = tmp_path / "own.toml"
    own.write_text(renamed_profile(name), "utf-8")
    database = Database(sqlite_settings.effective_database_url)
    try:
        if name == "thesis-5-9":  # the id that the profile thesis-5.9 takes
            with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
                client.post(DEVICES, json=body(LENS, name)).raise_for_status()
        detail = refusal(sqlite_settings, own, database)
    finally:
        database.close()
    assert words in detail
    assert repr(name)[1:-1] in detail


def test_another_profile_of_the_same_name(
    settings: Settings, database: Database, window: Path
) -> None:
    prepare(named(settings, window), database)
    window.write_text(renamed_profile("window-1").replace('"14 um"', '"13 um"'), "utf-8")
    kept = settings.folders.profiles / "window-1.toml"
    assert str(kept) in refusal(settings, window, database)
    # Nor does it become the device's when the one it was made from is taken away.
    kept.unlink()
    assert "is gone" in refusal(settings, window, database)


def test_what_the_service_cannot_make_a_device_of(
    sqlite_settings: Settings, tmp_path: Path
) -> None:
    database = Database(sqlite_settings.effective_database_url)
    lens = renamed_profile("mine", LENS)
    try:
        for change, words in (
            (('"10.59 um"', "10.59"), "pixels.pitch"),
            (('pitch = "10.59 um"', 'pitch = "10.59 um"\npich = 1'), "pixels.pich"),
            (('"camera-1"', f'"{"c" * 65}"'), "sensor 1"),
            (('title = "The', 'title = "\\u0000The'), "title"),
            (('"1133 mm"]', '"-1133 mm"]'), "volume"),
        ):
            own = tmp_path / "own.toml"
            assert change[0] in lens
            own.write_text(lens.replace(*change), "utf-8")
            assert words in refusal(sqlite_settings, own, database), change
        assert "nothing.toml" in refusal(sqlite_settings, tmp_path / "nothing.toml", database)
    finally:
        database.close()


def test_the_ids_of_built_in_profiles_devices_differ() -> None:
    ids = [device_id(name) for name in profile_names()]
    assert len(set(ids)) == len(ids)
    with pytest.raises(LumilineError):
        parse_profile("", "nothing")


# Nominal calibrations over REST


@pytest.mark.slow
def test_a_simulated_profile_is_calibrated_by_its_geometry(sqlite_client: Any) -> None:
    assert sqlite_client.post(DEVICES, json=body("bar")).status_code == 201
    made = sqlite_client.post(NOMINAL, json={"device_id": "made"})
    assert made.status_code == 201, made.text
    found = made.json()
    assert made.headers["Location"] == "/api/v1/calibrations/made-nominal"
    assert (found["provenance"], found["state"], found["points"]) == ("nominal", "available", [])
    assert "nothing was measured" in found["note"]
    expected = nominal_calibration(load_profile("bar"))
    fits = found["result"]["sensors"]
    assert [one["model"]["name"] for one in fits] == [one.model.name for one in expected.sensors]
    assert fits[0]["model"]["offset_x_mm"] == pytest.approx(expected.models[0].offset_x_mm)
    # It is not active before somebody says so, and is not made twice.
    assert sqlite_client.get(f"{DEVICES}/made").json()["active_calibration_id"] is None
    taken = sqlite_client.post(NOMINAL, json={"device_id": "made", "id": "made-nominal"})
    assert taken.status_code == 409
    named = sqlite_client.post(NOMINAL, json={"device_id": "made", "id": "again"})
    assert (named.status_code, named.json()["id"]) == (201, "again")
    assert sqlite_client.post("/api/v1/calibrations/again/activate").status_code == 200


def test_a_device_without_a_profile_has_no_nominal_calibration(sqlite_client: Any) -> None:
    refused = sqlite_client.post(NOMINAL, json={"device_id": "sim", "id": "other"})
    assert refused.status_code == 422
    assert "only a device that is simulated from a profile" in refused.json()["detail"]
    assert sqlite_client.post(NOMINAL, json={"device_id": "none"}).status_code == 404


def test_gray_tracks_have_no_nominal_calibration(sqlite_client: Any) -> None:
    profile = next(one for one in profile_names() if readout_of(load_profile(one)) == "gray-tracks")
    assert sqlite_client.post(DEVICES, json=body(profile)).status_code == 201
    refused = sqlite_client.post(NOMINAL, json={"device_id": "made"})
    assert (refused.status_code, "Gray tracks" in refused.json()["detail"]) == (422, True)


def nominal(client: Any, **members: Any) -> dict[str, Any]:
    made = client.post(NOMINAL, json={"device_id": "made"} | members)
    assert made.status_code == 201, made.text
    found: dict[str, Any] = made.json()
    return found


def activation(client: Any, calibration_id: str) -> Any:
    return client.post(f"/api/v1/calibrations/{calibration_id}/activate")


HARDWARE = {"kind": "external"}


def external_source(client: Any) -> dict[str, Any]:
    return HARDWARE | {"sensors": client.get(f"{DEVICES}/made").json()["sensors"]}


@pytest.mark.slow
def test_a_nominal_calibration_names_its_profile_and_the_hash_of_its_file(sqlite_client: Any):
    sqlite_client.post(DEVICES, json=body("bar"))
    found = nominal(sqlite_client)
    toml = sqlite_client.get(f"{PROFILES}/bar").json()["toml"]
    digest = hashlib.sha256(toml.encode()).hexdigest()
    assert found["profile"] == {"profile_id": "bar", "content_hash": digest}
    assert f'"bar" (SHA-256 of its file {digest[:12]}...)' in found["note"]
    # It is part of what is hashed.
    hashed = {name: found[name] for name in ("provenance", "points", "result", "profile")}
    assert content_hash(hashed | {"device": "made"}) == found["content_hash"]
    listed = sqlite_client.get("/api/v1/calibrations", params={"device_id": "made"}).json()
    assert [one["profile"] for one in listed["items"]] == [found["profile"]]


@pytest.mark.slow
def test_a_nominal_calibration_is_not_activated_on_a_real_device(sqlite_client: Any) -> None:
    sqlite_client.post(DEVICES, json=body("bar"))
    made = nominal(sqlite_client)["id"]
    real = external_source(sqlite_client)
    assert sqlite_client.patch(f"{DEVICES}/made", json={"source": real}).status_code == 200
    refused = activation(sqlite_client, made)
    assert (refused.status_code, refused.json()["type"]) == (
        409, "/problems/nominal-calibration-mismatch",
    )  # fmt: skip
    for words in ('the profile "bar"', "external", "points that were measured"):
        assert words in refused.json()["detail"]
    assert sqlite_client.get(f"{DEVICES}/made").json()["active_calibration_id"] is None


@pytest.mark.slow
def test_the_source_stays_while_a_nominal_calibration_is_active(
    sqlite_client: Any, sqlite_settings: Settings
) -> None:
    keep(sqlite_settings, "other", renamed_profile("other", "bar"))
    sqlite_client.post(DEVICES, json=body("bar"))
    made = nominal(sqlite_client)["id"]
    assert activation(sqlite_client, made).status_code == 200
    before = sqlite_client.get(f"{DEVICES}/made").json()
    for source in (external_source(sqlite_client), body("other")["source"]):
        refused = sqlite_client.patch(f"{DEVICES}/made", json={"source": source, "title": "New"})
        assert (refused.status_code, refused.json()["type"]) == (409, "/problems/device-in-use")
        assert f'the nominal calibration "{made}"' in refused.json()["detail"]
        assert "a device of its own" in refused.json()["detail"]
        assert sqlite_client.get(f"{DEVICES}/made").json() == before
    # Another scene or rate of the same profile is the same geometry.
    source = body("bar", frame_rate_hz=10)["source"]
    assert sqlite_client.patch(f"{DEVICES}/made", json={"source": source}).status_code == 200


@pytest.mark.slow
def test_nothing_goes_back_to_a_nominal_calibration_of_another_profile(
    sqlite_client: Any, sqlite_settings: Settings
) -> None:
    keep(sqlite_settings, "other", renamed_profile("other", "bar"))
    sqlite_client.post(DEVICES, json=body("bar"))
    first = nominal(sqlite_client)["id"]
    assert activation(sqlite_client, first).status_code == 200
    with sqlite_client.app.state.database.write() as session:
        device = session.get_one(DeviceRow, "made")
        device.source = device.source | {"profile_id": "other"}
    second = nominal(sqlite_client)["id"]
    assert activation(sqlite_client, second).status_code == 200
    refused = sqlite_client.post(f"{DEVICES}/made/roll-back")
    assert (refused.status_code, refused.json()["type"]) == (
        409, "/problems/nominal-calibration-mismatch",
    )  # fmt: skip
    assert sqlite_client.get(f"{DEVICES}/made").json()["active_calibration_id"] == second


@pytest.mark.slow
def test_a_profile_whose_file_was_changed_needs_another_nominal_calibration(
    sqlite_client: Any, sqlite_settings: Settings
) -> None:
    keep(sqlite_settings, "mine", renamed_profile("mine", "bar"))
    sqlite_client.post(DEVICES, json=body("mine"))
    made = nominal(sqlite_client)["id"]
    keep(sqlite_settings, "mine", "# changed\n" + renamed_profile("mine", "bar"))
    refused = activation(sqlite_client, made)
    assert (refused.status_code, "before it was changed" in refused.json()["detail"]) == (409, True)
    assert activation(sqlite_client, nominal(sqlite_client)["id"]).status_code == 200


def test_the_simulators_calibration_is_of_all_that_simulate_the_same(sqlite_client: Any) -> None:
    """`lumiline simulate-serial` is a device of hardware with the simulator's own cameras."""
    sensors = sqlite_client.get(f"{DEVICES}/sim").json()["sensors"]
    source = HARDWARE | {"sensors": sensors}
    changed = sqlite_client.patch(f"{DEVICES}/sim", json={"source": source})
    assert changed.status_code == 200
    assert activation(sqlite_client, "sim-nominal").status_code == 200


def test_the_source_is_checked_again_when_the_calibration_is_stored(
    sqlite_client: Any, sqlite_settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep(sqlite_settings, "other", renamed_profile("other", "bar"))
    sqlite_client.post(DEVICES, json=body("bar"))
    answers: list[int] = []

    def and_change(name: str, toml: str) -> Any:
        source = body("other")["source"]
        changed = sqlite_client.patch(f"{DEVICES}/made", json={"source": source})
        answers.append(changed.status_code)
        return nominal_calibration(parse_profile(toml, name))

    monkeypatch.setattr(nominal_router, "nominal_in_process", and_change)
    refused = sqlite_client.post(NOMINAL, json={"device_id": "made"})
    assert (answers, refused.status_code) == ([200], 409)
    assert refused.json()["type"] == "/problems/nominal-calibration-mismatch"
    page = sqlite_client.get("/api/v1/calibrations", params={"device_id": "made"}).json()
    assert page["items"] == []


@pytest.mark.slow
def test_after_retiring_a_nominal_calibration_another_is_made(sqlite_client: Any) -> None:
    sqlite_client.post(DEVICES, json=body("bar"))
    first = nominal(sqlite_client)["id"]
    assert sqlite_client.post(f"/api/v1/calibrations/{first}/retire").status_code == 200
    second = nominal(sqlite_client)["id"]
    assert (first, second) == ("made-nominal", "made-nominal-2")
    assert activation(sqlite_client, second).status_code == 200


@pytest.mark.slow
def test_a_nominal_calibration_is_computed_in_a_process_of_its_own() -> None:
    profile = load_profile("bar")
    assert nominal_in_process("bar", profile_text("bar", Path())) == nominal_calibration(profile)


def test_a_nominal_calibration_that_takes_too_long_is_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.api.devices.nominal_calibration.TIMEOUT_S", 0.01)
    with pytest.raises(InvalidParameter, match="could not be computed within"):
        nominal_in_process("bar", profile_text("bar", Path()))
