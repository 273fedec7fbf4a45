"""Profiles that clients send: planned without being kept, and kept."""

import hashlib

import pytest

from service.api.planning.router import EXAMPLE
from service.settings import Settings
from tests.service.fake_pipeline import TestClient

PROFILES = "/api/v1/device-profiles"
PLANS = "/api/v1/profile-plans"


@pytest.mark.slow
def test_plan_of_a_sent_profile_is_that_of_its_own_geometry(sqlite_client: TestClient) -> None:
    near = sqlite_client.post(PLANS, json={"toml": EXAMPLE}).json()
    farther = EXAMPLE.replace('"1500 mm"]\nsize', '"2500 mm"]\nsize')
    far = sqlite_client.post(PLANS, json={"toml": farther}).json()
    assert near["profile_id"] == "wide-bar"
    assert far["volume"]["centre_mm"] == [0.0, 0.0, 2500.0]
    assert far["noise"]["median"][2] > near["noise"]["median"][2]
    assert sqlite_client.get(f"{PROFILES}/wide-bar").status_code == 404


def test_kept_profile_is_read_planned_and_simulated_by_its_name(sqlite_client: TestClient) -> None:
    made = sqlite_client.post(PROFILES, json={"toml": EXAMPLE})
    assert made.status_code == 201
    assert made.headers["location"] == f"{PROFILES}/wide-bar"
    assert sqlite_client.get(f"{PROFILES}/wide-bar").json() == made.json()
    asked = sqlite_client.get("/api/v1/audit", params={"object_kind": "device-profile"})
    (entry,) = asked.json()["items"]
    assert entry["operation"] == "create-device-profile"
    assert entry["object_id"] == "wide-bar"
    assert entry["after"] == {"sha256": hashlib.sha256(EXAMPLE.encode()).hexdigest()}
    device = {
        "id": "wide",
        "title": "Wide",
        "source": {"kind": "profile", "profile_id": "wide-bar"},
    }
    assert sqlite_client.post("/api/v1/devices", json=device).status_code == 201


@pytest.mark.parametrize("name", ["bar", "Wide bar", "../bar"])
def test_name_that_cannot_be_kept_is_refused(sqlite_client: TestClient, name: str) -> None:
    toml = EXAMPLE.replace('name = "wide-bar"', f'name = "{name}"', 1)
    answer = sqlite_client.post(PROFILES, json={"toml": toml})
    assert answer.status_code == 422
    assert "name is" in answer.json()["detail"]


def test_kept_profile_is_not_overwritten(sqlite_client: TestClient) -> None:
    assert sqlite_client.post(PROFILES, json={"toml": EXAMPLE}).status_code == 201
    assert sqlite_client.post(PROFILES, json={"toml": EXAMPLE + "\n"}).status_code == 422


@pytest.mark.slow
@pytest.mark.parametrize("path", [PROFILES, PLANS])
@pytest.mark.parametrize(
    "toml",
    [
        "nonsense",
        'name = "a"',
        EXAMPLE.replace('"1500 mm"', "1500"),
        "a = " + 5_000 * "[",
        "a = " + 5_000 * "9",
        "a" + 30_000 * ".a" + " = 1",
        "name = 0x" + 5_000 * "f",
    ],
    ids=range(7),
)
def test_text_that_is_no_profile_is_refused(
    sqlite_client: TestClient, path: str, toml: str
) -> None:
    assert sqlite_client.post(path, json={"toml": toml}).status_code == 422


@pytest.mark.parametrize("path", [PROFILES, PLANS])
def test_answer_to_thousands_of_unknown_keys_is_short(sqlite_client: TestClient, path: str) -> None:
    toml = "\n".join(f"k{number}=1" for number in range(7_000))
    answer = sqlite_client.post(path, json={"toml": toml})
    assert answer.status_code == 422
    assert answer.json()["context"]["field"] == "k0"
    assert len(answer.json()["context"]["problems"]) <= 50
    assert len(answer.content) <= 64 * 1024


def test_files_that_are_no_profiles_are_left_out_of_the_list(
    sqlite_client: TestClient, sqlite_settings: Settings
) -> None:
    before = sqlite_client.get(PROFILES).json()
    folder = sqlite_settings.folders.profiles
    folder.mkdir(exist_ok=True)
    (folder / "deep.toml").write_text("a = " + 5_000 * "[")
    (folder / "long.toml").write_text("a = " + 5_000 * "9")
    (folder / "binary.toml").write_bytes(bytes(range(256)))
    assert sqlite_client.get(PROFILES).json() == before
    for name in ("deep", "long", "binary"):
        answer = sqlite_client.get(f"{PROFILES}/{name}")
        assert answer.status_code == 422
        assert name in answer.json()["detail"]
