"""One of two gateways is killed, held up, or ended in order: the other goes on."""

import os
import signal
import time
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from service.api.idempotency import ORPHANED_AFTER
from service.database.gateway import DEAD_AFTER_S
from tests.service.gateways.conftest import Pair, ask, code, done, wait_for
from tests.service.gateways.test_two_gateways import post_run, running

pytestmark = [pytest.mark.postgres, pytest.mark.slow, pytest.mark.timeout(900)]


def holders(pair: Pair, lease: str = "devices") -> list[str]:
    query = "SELECT g.name FROM leases l JOIN gateways g ON gateway_id = g.id WHERE l.name LIKE "
    return [row[0] for row in pair.rows(f"{query}'{lease}%%'")]


def attempts(pair: Pair, run: str) -> tuple[Any, ...]:
    """State of a run, and what the audit log has of it."""
    state = pair.rows(f"SELECT state, owner, started_at, finished_at FROM runs WHERE id = '{run}'")
    return tuple(state[0])


def test_run_of_a_killed_gateway_is_interrupted_and_not_taken_up_again(
    new_pair: Pair, tmp_path: Path
) -> None:
    pair = new_pair
    pair.a.start()
    until = tmp_path / "go"
    assert post_run(pair, pair.a, "left", until) is pair.a
    pair.b.start()
    # That B starts, and looks, ends no run of A.
    time.sleep(2 * DEAD_AFTER_S)
    assert done(pair.b, "GET", "/runs/left")["state"] == "running"
    pair.a.kill()
    begun = time.monotonic()
    wait_for(lambda: done(pair.b, "GET", "/runs/left")["state"] != "running")
    print(f"interrupted after {time.monotonic() - begun:.1f} s")
    left = attempts(pair, "left")
    assert left[0] == "interrupted"
    until.touch()
    pair.a.start()
    done(pair.b, "POST", "/runs/calibration", _quick("after"))
    wait_for(lambda: done(pair.a, "GET", "/runs/after")["state"] == "succeeded")
    assert attempts(pair, "left") == left
    wait_for(lambda: running(pair.b))  # A comes back too late for the devices
    assert code(ask(pair.a, "GET", "/devices/sim/state")) == (421, "device-elsewhere")
    assert holders(pair) == [pair.name(pair.b)]


def _quick(name: str) -> dict[str, Any]:
    from tests.service.crash.clients import POINTS

    return {"id": name, "device_id": "sim", "points": POINTS}


def test_gateway_that_was_held_up_gives_the_devices_up(new_pair: Pair, tmp_path: Path) -> None:
    pair = new_pair
    pair.start()
    wait_for(lambda: running(pair.a))
    run = post_run(pair, pair.a, "held-up", tmp_path / "go")
    os.kill(pair.a.process_id, signal.SIGSTOP)
    begun = time.monotonic()
    wait_for(lambda: running(pair.b))
    print(f"runs elsewhere after {time.monotonic() - begun:.1f} s")
    if run is pair.a:
        wait_for(lambda: done(pair.b, "GET", "/runs/held-up")["state"] == "interrupted")
    os.kill(pair.a.process_id, signal.SIGCONT)
    wait_for(lambda: ask(pair.a, "GET", "/devices/sim/state").status_code == 421)
    assert running(pair.b)
    assert holders(pair) == [pair.name(pair.b)]
    # Its run was told to be interrupted, and stays that, whatever it still makes of it.
    (tmp_path / "go").touch()
    if run is pair.a:
        done(pair.a, "POST", "/runs/calibration", _quick("next"))
        wait_for(lambda: done(pair.b, "GET", "/runs/next")["state"] == "succeeded")
        assert done(pair.a, "GET", "/runs/held-up")["state"] == "interrupted"
    # Both serve what they did.
    done(pair.a, "POST", "/calibrations", _quick("again"))
    done(pair.a, "POST", "/calibrations/again/activate")
    assert done(pair.b, "GET", "/devices/sim/state")["calibration_id"] == "again"


def test_gateway_that_ends_in_order_hands_over_at_once(new_pair: Pair) -> None:
    pair = new_pair
    pair.start()
    wait_for(lambda: running(pair.a))
    pair.a.stop()
    assert pair.rows("SELECT name FROM gateways") == [(pair.name(pair.b),)]
    wait_for(lambda: running(pair.b))
    assert "does not live any more" not in pair.b.log


def test_nothing_changes_hands_while_the_database_does_not_answer(new_pair: Pair) -> None:
    pair = new_pair
    pair.start()
    wait_for(lambda: running(pair.a))
    with pair.database.engine.connect() as connection:
        for _ in range(int(2 * DEAD_AFTER_S)):
            # As a restart does: every connection is gone, again and again.
            connection.exec_driver_sql(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE datname = current_database() AND pid != pg_backend_pid() "
                "AND pid IN (SELECT pid FROM pg_locks WHERE locktype = 'advisory' "
                "AND objid = (hashtext(current_schema())::bigint & 4294967295)::oid)"
            )
            time.sleep(0.5)
    wait_for(lambda: running(pair.a))
    assert holders(pair) == [pair.name(pair.a)]
    for one in pair.processes:
        assert "gateways: the database does not answer" in one.log
        assert "does not live any more" not in one.log


def test_unfinished_request_of_a_killed_gateway_is_forgotten(new_pair: Pair) -> None:
    pair = new_pair
    pair.start()
    body = {"id": "once", "title": "Once", "source": {"kind": "simulated"}}
    done(pair.a, "POST", "/devices", body, Idempotency_Key="k")
    pair.a.kill()
    wait_for(lambda: holders(pair) == [pair.name(pair.b)])

    def unfinished_for(age: timedelta) -> None:
        created = datetime.now(UTC) - age
        with pair.database.engine.begin() as connection:
            connection.exec_driver_sql(
                f"UPDATE idempotency_keys SET status = NULL, created_at = '{created.isoformat()}'"
            )

    unfinished_for(ORPHANED_AFTER / 2)
    busy = ask(pair.b, "POST", "/devices", body, Idempotency_Key="k")
    assert code(busy) == (409, "request-in-progress")
    unfinished_for(ORPHANED_AFTER)
    again = ask(pair.b, "POST", "/devices", body, Idempotency_Key="k")
    assert code(again) == (409, "device-exists")  # carried out, and refused as any


def test_shared_data_directory(sharing_pair: Pair) -> None:
    pair = sharing_pair
    folder = pair.a.data_dir / "recordings"
    folder.mkdir(parents=True)
    old = time.time() - 2 * 86_400
    for number in range(3):
        file = folder / f"old-{number}.h5"
        file.write_bytes(b"no recording")
        os.utime(file, (old, old))
    pair.start()
    a, b = pair.processes
    assert len(holders(pair, "files/")) == 1
    wait_for(lambda: running(a))
    done(a, "POST", "/devices/sim/recordings", {"id": "first.h5"})
    for one, gateway in ((a, None), (b, pair.name(a))):
        found = done(one, "GET", "/recordings/first.h5")
        assert (found["state"], found["gateway"]) == ("recording", gateway)
    assert code(ask(b, "GET", "/recordings/first.h5/file")) == (409, "recording-in-progress")
    assert code(ask(b, "DELETE", "/recordings/first.h5")) == (409, "recording-in-progress")
    assert code(ask(b, "POST", "/recordings/first.h5/stop")) == (421, "file-elsewhere")
    stopped = done(a, "POST", "/recordings/first.h5/stop")
    assert done(b, "GET", "/recordings/first.h5") == stopped  # at once, and from the file
    assert ask(b, "GET", "/recordings/first.h5/file").content == (folder / "first.h5").read_bytes()
    listed = [one["id"] for one in done(b, "GET", "/recordings")["items"]]
    assert sorted(listed) == ["first.h5", "old-0.h5", "old-1.h5", "old-2.h5"]
    # Unreadable ones are held, by the one that tidies; the other does not look.
    checked = [done(one, "GET", "/recording-retention")["checked_at"] for one in (a, b)]
    assert [one is None for one in checked] == [False, True]
    a.kill()
    wait_for(lambda: done(b, "GET", "/recording-retention")["checked_at"] is not None)
    done(b, "DELETE", "/recordings/first.h5")


def test_watch_samples_are_of_one_gateway(new_pair: Pair) -> None:
    pair = new_pair
    pair.start()
    wait_for(lambda: running(pair.a))
    settings = {"interval_s": 10}
    done(pair.b, "PUT", "/devices/sim/watch", settings, If_Match="*")
    wait_for(lambda: len(done(pair.b, "GET", "/watch-samples")["items"]) >= 1)
    pair.a.kill()
    before = len(done(pair.b, "GET", "/watch-samples")["items"])
    wait_for(lambda: len(done(pair.b, "GET", "/watch-samples")["items"]) > before)
    at = [row[0] for row in pair.rows("SELECT at FROM watch_samples ORDER BY at")]
    assert all((later - earlier).total_seconds() > 5 for earlier, later in pairwise(at))
