"""RemoteHolds: a beam is enabled while the station says so, and not a moment longer."""

import time
from typing import Any

import pytest

from compute.pose.beam_hold import BeamHoldCause
from service.pipeline.frame_batch import BeamHoldState
from service.station.bus_messages import hold_message, read_hold, split_message
from service.station.remote_holds import GRACE_S, RemoteHolds

LATER_S = 1000.0


class Bench:
    """Holds of a station that is played by hand: what it says goes through bytes."""

    def __init__(self) -> None:
        self.told: list[tuple[str, bool, str | None, bool]] = []
        self.published: list[BeamHoldState] = []
        self.holds = RemoteHolds(
            lambda _: True, lambda _: None, lambda _, now: self.published.append(now)
        )
        self.end = self.holds.listen(
            lambda device, now, last: self.told.append((device, now.held, now.reason, last))
        )

    def state(self, revision: int, *, held: bool, in_s: float = LATER_S) -> BeamHoldState:
        """What the station says of a state, read but not yet taken as a change."""
        cause = BeamHoldCause.MOVED if held else BeamHoldCause.NONE
        now = BeamHoldState("watch", held, cause, "far" if held else None, 5, revision=revision)
        _, header, _ = split_message(hold_message("sim", now, last=False))
        row: list[Any] = header[1]
        if not held:
            row[1] = time.monotonic() + in_s
        return read_hold(row, self.holds)

    def say(self, revision: int, *, held: bool, in_s: float = LATER_S) -> BeamHoldState:
        """Take a change."""
        now = self.state(revision, held=held, in_s=in_s)
        self.holds.change("sim", now, last=False)
        return now


def held(bench: Bench) -> bool:
    now = bench.holds.now("watch")
    assert now is not None
    return now.held


def test_changes_are_told_in_order() -> None:
    bench = Bench()
    bench.say(1, held=True)
    bench.say(2, held=False)
    assert not held(bench)
    bench.say(3, held=True)
    assert held(bench)
    assert bench.told == [
        ("sim", True, "far", False), ("sim", False, None, False), ("sim", True, "far", False),
    ]  # fmt: skip
    assert [now.revision for now in bench.published] == [1, 2, 3]
    assert [now.held for now in bench.holds.of_device("sim")] == [True]
    assert list(bench.holds.all()) == ["sim"]
    bench.end()
    bench.say(4, held=False)
    assert len(bench.told) == 3


def test_what_said_enabled_says_held_once_it_is() -> None:
    bench = Bench()
    before = bench.say(1, held=False)
    assert not before.superseded
    bench.say(2, held=True)
    assert before.superseded
    assert before.standing.reason == "far"


def test_a_batch_from_before_the_hold_enables_nothing() -> None:
    """The watchdog's word may overtake that of a batch which was made before it."""
    bench = Bench()
    bench.say(5, held=True)
    late = bench.state(4, held=False)
    assert late.superseded
    assert late.standing.held
    bench.holds.change("sim", late, last=False)
    assert held(bench)
    bench.say(6, held=False)
    assert not held(bench)


def test_batch_from_before_a_hold_was_deleted_does_not_bring_it_back() -> None:
    bench = Bench()
    bench.say(1, held=False)
    deleted = bench.state(3, held=True)
    bench.holds.change("sim", deleted, last=True)
    late = bench.state(2, held=False)
    bench.holds.take("sim", [late])
    assert late.standing.held
    assert bench.holds.now("watch") is None
    assert bench.holds.of_device("sim") == ()
    assert bench.told[-1] == ("sim", True, "far", True)
    # A new one of its name is another one.
    bench.say(4, held=True)
    bench.say(5, held=False)
    assert not held(bench)


def test_keep_tells_of_all_other_holds_that_they_were_deleted() -> None:
    bench = Bench()
    bench.say(1, held=False)
    bench.holds.keep("sim", {"watch"})
    assert len(bench.told) == 1
    bench.holds.keep("sim", {"another"})
    assert bench.holds.now("watch") is None
    assert bench.told[-1] == ("sim", True, "the hold was deleted", True)
    assert bench.published[-1].standing.held


def test_deadline_holds_without_a_word() -> None:
    bench = Bench()
    bench.say(1, held=False, in_s=0.02)
    wait_s = bench.holds.check()
    assert wait_s is not None
    assert 0.0 < wait_s <= 0.02 + GRACE_S
    time.sleep(0.03)
    assert held(bench)  # whoever asks is told at once
    time.sleep(GRACE_S)
    assert bench.holds.check() is None
    assert bench.told[-1][1]
    assert "has not said" in str(bench.told[-1][2])
    bench.say(2, held=True)
    bench.say(3, held=False)
    assert not held(bench)


@pytest.mark.parametrize("checked", [True, False])
def test_batches_tell_that_a_beam_goes_on_whose_deadline_had_passed(checked: bool) -> None:
    """The station never held it, so that no change of it comes."""
    bench = Bench()
    bench.say(1, held=False, in_s=0.01)
    time.sleep(0.02 + GRACE_S)
    if checked:
        bench.holds.check()
        assert bench.published[-1].held
    count = len(bench.published)
    for _ in range(2):
        bench.holds.take("sim", [bench.state(1, held=False)])
        assert not held(bench)
    assert len(bench.published) == len(bench.told) == count + 1
    assert not bench.published[-1].standing.held


def test_newer_data_move_the_deadline() -> None:
    bench = Bench()
    bench.say(1, held=False, in_s=0.02)
    bench.state(2, held=False, in_s=LATER_S)
    time.sleep(0.03 + GRACE_S)
    assert bench.holds.check() > LATER_S - 10.0  # type: ignore[operator]
    assert not held(bench)


def test_lost_station_holds_all_and_its_successor_counts_anew() -> None:
    bench = Bench()
    enabled = bench.say(900, held=False)
    bench.holds.fail("the station ended")
    assert enabled.superseded
    assert held(bench)
    assert bench.told[-1] == ("sim", True, "the station ended", False)
    bench.say(1, held=True)
    bench.say(2, held=False)
    assert not held(bench)


def test_deleted_hold_is_gone() -> None:
    bench = Bench()
    now = bench.say(1, held=True)
    bench.holds.change("sim", now, last=True)
    assert bench.holds.now("watch") is None
    assert bench.told[-1][3]


@pytest.mark.parametrize("known", [True, False])
def test_acknowledge_asks_the_station(known: bool) -> None:
    asked = []

    def acknowledge(hold_id: str) -> bool:
        asked.append(hold_id)
        return known

    holds = RemoteHolds(acknowledge, print, lambda *_: None)
    assert holds.acknowledge("watch") is None
    assert asked == ["watch"]
