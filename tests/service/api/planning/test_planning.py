"""Device profiles and plans over REST."""

import tomllib
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import pytest

from compute.optics.profiles.profile_loader import load_profile, parse_profile, profile_names
from compute.planning.plan import plan
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.planning.plan_cache import ResultCache
from service.problems.errors import Busy

PROFILES = "/api/v1/device-profiles"


def test_all_profiles_are_listed(sqlite_client: Any) -> None:
    found = sqlite_client.get(PROFILES, params={"limit": 200}).json()["items"]
    assert [one["id"] for one in found] == list(profile_names())
    [bar] = [one for one in found if one["id"] == "bar"]
    assert (bar["sensor_count"], bar["pixel_count"]) == (4, 2048)


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_is_what_its_file_says(sqlite_client: Any, name: str) -> None:
    answer = sqlite_client.get(f"{PROFILES}/{name}")
    assert answer.status_code == 200
    found, profile = answer.json(), load_profile(name)
    assert parse_profile(found["toml"], "answer") == profile
    assert tomllib.loads(found["toml"])["title"] == found["title"] == profile.title
    assert [sensor["name"] for sensor in found["sensors"]] == [one.name for one in profile.sensors]
    assert found["assumed"] == dict(profile.assumed)
    assert found["volume"]["size_mm"] == list(profile.volume.size_mm)
    assert found["error_sources"]["distortion"] == profile.error_sources.distortion


@pytest.mark.slow
def test_a_plan_is_the_library_s(sqlite_client: Any) -> None:
    found = sqlite_client.get(f"{PROFILES}/bar/plan?grid=3").json()
    ours = plan(load_profile("bar"), grid=3)
    assert found["grid"] == [3, 3, 3]
    assert found["noise"]["centre"] == list(ours.noise.centre or ())
    assert len(found["points"]) == 27
    assert ours.budget is not None
    assert found["budget"]["dominant"] == ours.budget.dominant
    assert found["budget"]["total"]["centre"] == list(ours.budget.total.centre or ())
    assert [one["name"] for one in found["budget"]["contributions"]] == [
        one.name for one in ours.budget.contributions
    ]
    assert {one["name"]: one["assumed"] for one in found["budget"]["inputs"]}["timing"]
    assert found["ghosts"][0]["markers"] == 2
    assert found["ghosts"][-1]["markers"] == load_profile("bar").markers.max_markers
    again = sqlite_client.get(f"{PROFILES}/bar/plan?grid=3")
    assert again.json() == found


@pytest.mark.slow
def test_a_plan_is_drawn(sqlite_client: Any) -> None:
    answer = sqlite_client.get(f"{PROFILES}/bar/plan.png?grid=3")
    assert answer.headers["content-type"] == "image/png"
    assert answer.content.startswith(b"\x89PNG")
    assert len(answer.content) > 20_000


def test_results_are_worked_out_once_and_the_oldest_go() -> None:
    results = ResultCache[int](ConcurrencyLimit(1, "busy"), 2)
    calls: list[str] = []

    def get(key: str) -> int:
        def work() -> int:
            calls.append(key)
            return len(calls)

        return results.get(key, work)

    assert [get(key) for key in ("a", "b", "a", "c", "b", "a")] == [1, 2, 1, 3, 2, 4]


def test_no_more_at_once_than_may_be() -> None:
    """While a slot is taken, the next is refused; what is known is given all the same."""
    results = ResultCache[str](ConcurrencyLimit(1, "busy"), 8)
    results.get("known", lambda: "known")
    begun, go_on = Event(), Event()

    def slow() -> str:
        begun.set()
        assert go_on.wait(240.0)
        return "slow"

    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(results.get, "slow", slow)
        assert begun.wait(240.0)
        with pytest.raises(Busy, match="busy"):
            results.get("other", lambda: "other")
        assert results.get("known", lambda: "new") == "known"
        go_on.set()
        assert working.result(30.0) == "slow"
    assert results.get("other", lambda: "other") == "other"


def test_a_failure_gives_its_slot_back() -> None:
    results = ResultCache[str](ConcurrencyLimit(1, "busy"), 8)

    def fails() -> str:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        results.get("a", fails)
    assert results.get("a", lambda: "yes") == "yes"


def test_busy_is_answered_with_when_to_try_again(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "service.api.planning.plan_cache._plans", ResultCache[Any](ConcurrencyLimit(1, "busy"), 8)
    )
    from service.api.planning import plan_cache

    plan_cache._plans._limit.__enter__()
    answer = sqlite_client.get(f"{PROFILES}/bar/plan")
    assert answer.status_code == 503
    assert answer.json()["type"] == "/problems/busy"
    assert int(answer.headers["retry-after"]) > 0
