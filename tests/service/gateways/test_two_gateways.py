"""Two gateways on one database: what was said at one holds at the other."""

from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tests.service.crash.clients import POINTS
from tests.service.crash.process import ServiceProcess
from tests.service.crash.test_random_commands import children
from tests.service.gateways.conftest import Pair, ask, code, done, wait_for

pytestmark = [pytest.mark.postgres, pytest.mark.slow, pytest.mark.timeout(900)]

HOLD = {"device_id": "sim", "title": "Chest", "limits": {"shift_mm": 5},
        "watch": {"kind": "marker", "marker": 0}}  # fmt: skip


def running(process: ServiceProcess, device: str = "sim") -> bool:
    answer = ask(process, "GET", f"/devices/{device}/state")
    return answer.status_code == 200 and answer.json()["state"] == "running"


def post_run(pair: Pair, at: ServiceProcess, name: str, until: Path) -> ServiceProcess:
    """Post a run that waits for a file, and return the gateway that computes it."""
    body = {"id": name, "device_id": "sim", "points": POINTS, "note": f"until {until}"}
    done(at, "POST", "/runs/calibration", body)
    owner = "SELECT g.name FROM runs r JOIN gateways g ON g.id = r.owner WHERE r.id = "
    found = wait_for(lambda: pair.rows(f"{owner}'{name}'"))[0][0]
    return next(one for one in pair.processes if pair.name(one) == found)


def workers(process: ServiceProcess) -> list[int]:
    """Grandchildren that compute: those of the process that workers are forked from."""
    return [worker for one in children(process.process_id) for worker in children(one)]


def test_one_has_the_devices_and_each_its_directory(pair: Pair) -> None:
    leases = dict(
        pair.rows("SELECT l.name, g.name FROM leases l JOIN gateways g ON gateway_id = id")
    )
    assert leases.pop("devices") == pair.name(pair.a)
    assert sorted(leases.values()) == sorted(map(pair.name, pair.processes))
    wait_for(lambda: running(pair.a))
    refused = ask(pair.b, "GET", "/devices/sim/state")
    assert code(refused) == (421, "device-elsewhere")
    assert refused.json()["context"] == {"device_id": "sim", "gateway": pair.name(pair.a)}
    for method, path in (
        ("POST", "/devices/sim/start"),
        ("POST", "/devices/sim/stop"),
        ("GET", "/devices/sim/scans"),
        ("GET", "/devices/sim/frames"),
        ("POST", "/devices/sim/recordings"),
    ):
        body = {} if path.endswith("recordings") else None
        assert code(ask(pair.b, method, path, body)) == (421, "device-elsewhere"), path
    assert running(pair.a)
    url = f"{pair.b.url}/api/v1/stream?device_id=sim".replace("http", "ws", 1)
    with pytest.raises(InvalidStatus) as refusal, connect(url):
        pass
    assert refusal.value.response.status_code == 421


@pytest.mark.parametrize("end", ["cancelled", "succeeded"])
def test_run_posted_at_one_is_followed_at_the_other(pair: Pair, end: str, tmp_path: Path) -> None:
    name, until = f"run-{end}", tmp_path / "go"
    before = set(workers(pair.a) + workers(pair.b))
    post_run(pair, pair.a, name, until)
    for one in pair.processes:
        run = wait_for(lambda at=one: (r := done(at, "GET", f"/runs/{name}"))["progress"] and r)
        assert (run["state"], run["progress"], run["stage"]) == ("running", 0.5, "waits")
    if end == "cancelled":
        assert done(pair.b, "POST", f"/runs/{name}/cancel")["state"] == "cancelled"
        assert done(pair.a, "GET", f"/runs/{name}")["state"] == "cancelled"
        wait_for(lambda: not set(workers(pair.a) + workers(pair.b)) - before)
    else:
        until.touch()
        wait_for(lambda: done(pair.b, "GET", f"/runs/{name}")["state"] != "running")
    for one in pair.processes:
        found = done(one, "GET", f"/runs/{name}")
        assert (found["state"], found["problem"]) == (end, None)


def test_key_revoked_at_one_is_refused_at_the_other_at_once(pair: Pair) -> None:
    made = done(pair.a, "POST", "/keys", {"name": "n", "scopes": ["read:stream"]})
    credential = f"Bearer {made['key']}"
    for one in pair.processes:
        assert ask(one, "GET", "/devices", Authorization=credential).status_code == 200
    done(pair.a, "POST", f"/keys/{made['id']}/revoke")
    assert code(ask(pair.b, "GET", "/devices", Authorization=credential)) == (
        401,
        "unauthenticated",
    )


def test_failed_logins_are_counted_together(pair: Pair) -> None:
    wrong = f"Bearer lumi_{'a' * 12}_{'b' * 43}"
    answers = [
        ask(one, "GET", "/devices", Authorization=wrong).status_code for one in (pair.a, pair.b) * 4
    ]
    assert answers.count(429) >= 2  # of 8, at 5 a minute
    for one in pair.processes:
        refused = ask(one, "GET", "/devices", Authorization=wrong)
        assert code(refused) == (429, "too-many-attempts")


def test_activation_at_one_holds_at_the_other(pair: Pair) -> None:
    a, b = pair.processes
    wait_for(lambda: running(a))
    for name in ("first", "second"):
        done(a, "POST", "/calibrations", {"id": name, "device_id": "sim", "points": POINTS})
    before = ask(b, "GET", "/devices/sim").headers["ETag"]
    for at, other, name in ((a, b, "first"), (b, a, "second")):
        done(at, "POST", f"/calibrations/{name}/activate")
        # The running device uses it when the answer is there, wherever that was given.
        assert done(a, "GET", "/devices/sim/state")["calibration_id"] == name
        documents = [ask(one, "GET", "/devices/sim") for one in (other, at)]
        assert {one.json()["active_calibration_id"] for one in documents} == {name}
        tags = {one.headers["ETag"] for one in documents}
        assert len(tags) == 1
        assert tags != {before}
        refused = ask(other, "POST", "/calibrations/sim-nominal/activate?expected=other")
        assert code(refused) == (409, "activation-conflict")
    for at, other in ((a, b), (b, a)):
        tag = ask(other, "GET", "/devices/sim").headers["ETag"]
        done(at, "PATCH", "/devices/sim", {"title": f"By {at.port}"}, If_Match=tag)
        stale = ask(other, "PATCH", "/devices/sim", {"title": "Stale"}, If_Match=tag)
        assert code(stale) == (412, "precondition-failed")
    assert code(ask(b, "DELETE", "/devices/sim?cascade=true", If_Match=before)) == (
        412,
        "precondition-failed",
    )


def test_tools_and_holds_made_at_one_are_followed_where_the_device_is(pair: Pair) -> None:
    a, b = pair.processes
    wait_for(lambda: running(a))
    done(b, "POST", "/tools", {"id": "probe", "device_id": "sim", "title": "Probe",
         "markers_mm": [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]],
         "strobe_markers": [0, 1, 2, 3]})  # fmt: skip
    assert "device" not in code(ask(a, "GET", "/tools/probe/pose"))[1]
    assert code(ask(b, "GET", "/tools/probe/pose")) == (421, "device-elsewhere")
    hold = {"device_id": "sim", "title": "Chest", "limits": {"shift_mm": 5}, "id": "chest",
            "watch": {"kind": "tool", "tool_id": "probe"}}  # fmt: skip
    done(b, "POST", "/beam-holds", hold)
    # Watched: one that is not says so.
    assert done(a, "GET", "/beam-holds/chest/state")["reason"] != "it is not watched"
    assert code(ask(b, "GET", "/beam-holds/chest/state")) == (421, "device-elsewhere")
    done(b, "DELETE", "/beam-holds/chest")
    done(b, "DELETE", "/tools/probe")
    assert code(ask(a, "GET", "/beam-holds/chest/state")) == (404, "unknown-beam-hold")


def test_device_deleted_at_one_ends_at_the_other(pair: Pair) -> None:
    a, b = pair.processes
    body = {"id": "brief", "title": "Brief", "source": {"kind": "simulated"}}
    done(b, "POST", "/devices", body)
    done(a, "POST", "/devices/brief/start")
    wait_for(lambda: running(a, "brief"))
    done(b, "DELETE", "/devices/brief")
    assert "brief" not in [
        line for line in metrics(a) if line.startswith("lumiline_frames_received_total")
    ]
    assert not any('device="brief"' in line for line in metrics(a))


def metrics(process: ServiceProcess) -> list[str]:
    import httpx

    return httpx.get(f"{process.url}/metrics", timeout=60.0).text.splitlines()


def test_idempotency_key_used_at_one_is_known_at_the_other(pair: Pair) -> None:
    body = {"id": "once", "title": "Once", "source": {"kind": "simulated"}}
    first = ask(pair.a, "POST", "/devices", body, Idempotency_Key="k1")
    again = ask(pair.b, "POST", "/devices", body, Idempotency_Key="k1")
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.headers["Idempotent-Replayed"] == "true"
    assert again.content == first.content
    other = ask(pair.b, "POST", "/devices", body | {"title": "Twice"}, Idempotency_Key="k1")
    assert code(other) == (422, "idempotency-key-reused")


def test_capture_session_begun_at_one_is_known_at_the_other_which_says_who_captures(
    pair: Pair,
) -> None:
    a, b = pair.processes
    body = {"id": "frame", "device_id": "sim", "targets": [
        {"name": f"T{number}", "position_mm": [number, 0, 0]} for number in range(6)]}  # fmt: skip
    begun = done(b, "POST", "/captures", body)
    assert done(a, "GET", "/captures/frame") == begun
    refused = ask(b, "POST", "/captures/frame/capture")
    assert code(refused) == (421, "device-elsewhere")
    assert pair.name(a) in refused.json()["detail"]
    assert ask(a, "POST", "/captures/frame/capture").status_code in (200, 409)


def test_recording_of_one_is_listed_at_the_other_with_where_it_is(pair: Pair) -> None:
    a, b = pair.processes
    wait_for(lambda: running(a))
    done(a, "POST", "/devices/sim/recordings", {"id": "first.h5"})

    def listed(at: ServiceProcess) -> Any:
        found = done(at, "GET", "/recordings")["items"]
        return next((one for one in found if one["id"] == "first.h5"), None)

    assert listed(a)["gateway"] is None
    there = listed(b)  # at once
    assert (there["gateway"], there["state"]) == (pair.name(a), "recording")
    for method, path in (
        ("POST", "/recordings/first.h5/stop"),
        ("GET", "/recordings/first.h5/file"),
        ("GET", "/recordings/first.h5/frames"),
        ("DELETE", "/recordings/first.h5"),
    ):
        refused = ask(b, method, path)
        assert code(refused) == (421, "file-elsewhere"), path
        assert refused.json()["context"]["gateway"] == pair.name(a)
    stopped = done(a, "POST", "/recordings/first.h5/stop")
    there = done(b, "GET", "/recordings/first.h5")
    assert there == stopped | {"gateway": pair.name(a)}
    export = {"id": "exported", "device_id": "sim", "recording_id": "first.h5", "format": "csv"}
    assert code(ask(b, "POST", "/runs/export", export)) == (421, "file-elsewhere")
    done(a, "POST", "/runs/export", export | {"result_id": "table"})
    run = wait_for(
        lambda: (
            (one := done(b, "GET", "/runs/exported"))["state"] not in ("queued", "running") and one
        )
    )
    assert run["state"] == "succeeded", run
    wait_for(lambda: ask(b, "GET", "/exports/table").status_code == 200)
    assert done(b, "GET", "/exports/table")["gateway"] == pair.name(a)
    assert code(ask(b, "GET", "/exports/table/file")) == (421, "file-elsewhere")
    assert ask(a, "GET", "/exports/table/file").status_code == 200
    done(a, "DELETE", "/recordings/first.h5")
    wait_for(lambda: listed(b) is None)
