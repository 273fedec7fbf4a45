"""Frames that are followed when there is no time for all: made-up devices, costs and a thread."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.pipeline.device_session import (
    BEGIN_S,
    BEHIND_S,
    CAUGHT_UP_S,
    END_S,
    SLICE_S,
    LoadShedding,
)

MOST = 64
Cost = Callable[[float], float]


@dataclass
class Device:
    """A device whose frames wait for a thread that takes its time for each.

    Args:
        frame_s: what it costs to follow a frame that is begun at a time [s].
        rate_hz: of its frames.
        markers: lit in turn; 0: together.
        rest_s: what a batch costs besides.
    """

    frame_s: Cost | float
    rate_hz: float = 1000.0
    markers: int = 4
    rest_s: float = 0.2e-3
    followed: list[tuple[int, float, float]] = field(default_factory=list)
    """Frame, when it was exposed, and when its batch was done."""
    passed_over: list[int] = field(default_factory=list)
    batches: list[tuple[bool, ...]] = field(default_factory=list)
    thinned: list[tuple[float, bool]] = field(default_factory=list)
    oldest_s: float = 0.0

    def __post_init__(self) -> None:
        self.load_shedding = LoadShedding(self.rate_hz)
        self.waiting: deque[int] = deque()
        self.exposed = 0

    def expose(self, now_s: float) -> None:
        """Have all frames wait that were exposed by now."""
        while self.exposed / self.rate_hz <= now_s:
            self.waiting.append(self.exposed)
            self.exposed += 1

    def slot(self, frame: int) -> int | None:
        return frame % self.markers if self.markers else None

    def work(self, now_s: float) -> float:
        """Do a batch, and return when it is done."""
        taken = [self.waiting.popleft() for _ in range(min(MOST, len(self.waiting)))]
        track = self.load_shedding.choose([self.slot(one) for one in taken], len(self.waiting))
        assert 1 <= len(track) <= len(taken)
        self.waiting.extendleft(reversed(taken[len(track) :]))
        done_s = now_s
        for frame, wanted in zip(taken, track, strict=False):
            done_s += self.cost(done_s) if wanted else 0.0
            if not wanted:
                self.passed_over.append(frame)
        self.load_shedding.count(sum(track), done_s - now_s, self.rest_s)
        done_s += self.rest_s
        self.followed += [
            (frame, frame / self.rate_hz, done_s)
            for frame, wanted in zip(taken, track, strict=False)
            if wanted
        ]
        self.batches.append(track)
        self.thinned.append((now_s, self.load_shedding.sheds))
        return done_s

    def cost(self, now_s: float) -> float:
        return self.frame_s(now_s) if callable(self.frame_s) else self.frame_s

    def since(self, begin_s: float) -> list[tuple[int, float, float]]:
        return [one for one in self.followed if one[1] >= begin_s]

    def share(self, begin_s: float, end_s: float) -> float:
        """Return how many of the frames of a time were followed."""
        here = sum(begin_s <= at < end_s for _, at, _ in self.followed)
        return here / ((end_s - begin_s) * self.rate_hz)


def run(seconds: float, *devices: Device, stalls: Sequence[tuple[float, float]] = ()) -> None:
    """Let one thread work for devices; ``stalls`` are when it stands still, and for how long."""
    now_s, left = 0.0, deque(stalls)
    while now_s < seconds:
        if left and now_s >= left[0][0]:
            now_s += left.popleft()[1]
        busy = False
        for one in devices:
            one.expose(now_s)
            if one.waiting:
                now_s, busy = one.work(now_s), True
        if not busy:
            now_s = min(one.exposed / one.rate_hz for one in devices)


def latencies(followed: Sequence[tuple[int, float, float]]) -> list[float]:
    return sorted(done - at for _, at, done in followed)


def test_who_keeps_up_follows_all_and_hiccups_are_made_up_for():
    device = Device(0.6e-3)
    run(3.0, device, stalls=[(0.5, 0.9 * BEGIN_S), (1.5, 0.9 * BEGIN_S)])
    assert device.passed_over == []
    assert not device.load_shedding.sheds


@pytest.mark.parametrize("markers", range(9))
@pytest.mark.parametrize("frame_s", [1.2e-3, 1.5e-3, 3.1e-3, 7e-3])
def test_who_does_not_keep_up_follows_what_it_can_without_delay(markers: int, frame_s: float):
    device = Device(frame_s, markers=markers)
    run(4.0, device)
    late = latencies(device.since(0.5))
    # A slice until it is taken, one until it is done; a frame that costs more is as late.
    longest = max(SLICE_S, frame_s + device.rest_s)
    assert late[-1] <= 3.0 * longest
    assert late[len(late) // 2] <= 2.0 * longest
    # The thread never rests, but for what is too little for a frame.
    could = (1.0 - device.rest_s / SLICE_S) * 1e-3 / frame_s
    assert device.share(0.5, 3.9) >= 0.9 * could
    assert not device.load_shedding.behind


@pytest.mark.parametrize("markers", range(1, 9))
@pytest.mark.parametrize("frame_s", [1.05e-3, 1.5e-3, 1.8e-3, 3.7e-3, 7e-3])
def test_no_marker_is_left_out(markers: int, frame_s: float):
    device = Device(frame_s, markers=markers)
    run(4.0, device)
    here = device.since(0.5)
    mean = (here[-1][0] - here[0][0]) / len(here) * markers
    for slot in range(markers):
        frames = [frame for frame, _, _ in here if device.slot(frame) == slot]
        gaps = [after - before for before, after in pairwise(frames)]
        # Between two exposures of a marker lie whole turns, and a batch more at most.
        assert max(gaps) <= 2.0 * mean + markers + 1e3 * SLICE_S


def test_frames_that_are_lit_alike_are_followed_evenly():
    load_shedding = LoadShedding(1000.0)
    load_shedding.choose([None] * 8, 30)
    assert load_shedding.sheds
    load_shedding.count(8, 8 * SLICE_S / 4.0, 0.0)
    track = load_shedding.choose([None] * 8, 0)
    frames = [index for index, one in enumerate(track) if one]
    assert len(frames) == 4
    assert frames[-1] == 7
    assert max(after - before for before, after in pairwise(frames)) <= 3


@pytest.mark.parametrize("frame_s", [1.7e-3, 6e-3])
def test_the_newest_of_a_batch_is_followed(frame_s: float):
    device = Device(frame_s)
    run(2.0, device)
    assert all(batch[-1] for batch in device.batches)
    frames = sorted([frame for frame, _, _ in device.followed] + device.passed_over)
    assert frames == list(range(len(frames)))  # each once, and in order
    assert [one for one, _, _ in device.followed] == sorted(one for one, _, _ in device.followed)


def test_when_it_keeps_up_again_all_are_followed_again():
    device = Device(lambda now: 2e-3 if now < 2.0 else 0.5e-3)
    run(4.0, device)
    assert device.share(1.0, 2.0) < 0.6
    assert device.share(2.0 + 2.0 * END_S, 3.9) == pytest.approx(1.0, abs=1e-3)
    assert not device.load_shedding.sheds


@pytest.mark.parametrize("cost_ms", [0.9, 0.96, 1.0, 1.04, 1.1, 1.3])
def test_it_does_not_go_to_and_fro(cost_ms: float):
    # Every batch and every frame costs something else.
    def cost(now_s: float) -> float:
        return 1e-3 * (cost_ms - 0.05 + 0.3 * (math.sin(777.0 * now_s)))

    device = Device(cost, rest_s=0.05e-3)
    run(20.0, device)
    states = [sheds for _, sheds in device.thinned]
    changes = sum(a != b for a, b in pairwise(states))
    assert changes <= 4


def test_of_frames_that_waited_too_long_none_are_followed_until_it_has_caught_up():
    device = Device(1.5e-3)
    stall_s = 4.0 * BEHIND_S
    run(2.0, device, stalls=[(1.0, stall_s)])
    over = [one for one in device.passed_over if 1.0 <= one / 1000.0 < 1.0 + stall_s]
    late = latencies([one for one in device.followed if one[1] >= 0.9])
    assert len(over) >= 1000 * (stall_s - 2.0 * CAUGHT_UP_S)
    assert late[-1] <= BEHIND_S  # nothing that is followed is as old
    assert not device.load_shedding.behind


def test_devices_of_one_thread_get_the_same_time():
    alike = [Device(1.5e-3), Device(1.5e-3, markers=3), Device(1.5e-3, markers=0)]
    run(4.0, *alike)
    shares = [one.share(0.5, 3.9) for one in alike]
    could = (1.0 - 0.2e-3 / SLICE_S) / 1.5 / 3
    assert shares == pytest.approx([could] * 3, rel=0.15)
    for one in alike:
        assert latencies(one.since(0.5))[-1] <= 3.0 * 3 * SLICE_S


def test_a_device_that_needs_little_is_followed_beside_one_that_needs_much():
    little, much = Device(0.1e-3), Device(3e-3)
    run(4.0, little, much)
    assert little.share(0.5, 3.9) == pytest.approx(1.0, abs=1e-3)
    assert 0.15 <= much.share(0.5, 3.9) <= 0.3
    assert latencies(little.since(0.5))[-1] <= 3.0 * SLICE_S


def affordable(*counted: tuple[int, float, float]) -> int:
    """Return how many of 16 frames are followed after batches of such costs."""
    load_shedding = LoadShedding(1000.0)
    for one in counted:
        load_shedding.count(*one)
    track = load_shedding.choose([None] * 16, 30)
    assert load_shedding.sheds
    assert not load_shedding.behind
    return sum(track)


def test_a_batch_holds_what_there_is_time_for():
    assert affordable((8, 8e-3, 0.0)) == round(1e3 * SLICE_S)
    assert affordable((8, 8e-3, 0.5 * SLICE_S)) == round(0.5e3 * SLICE_S)
    assert affordable((1, 1e-3, 2.0 * SLICE_S)) == affordable((1, 2.0 * SLICE_S, 0.0)) == 1
    # A search, or a hiccup, is no cost of a frame.
    usual = [(2, 2e-3, 0.1e-3)] * 4
    assert affordable(*usual, (2, 60e-3, 0.1e-3), (2, 2e-3, 50e-3)) == affordable(*usual)


def test_a_search_now_and_then_leaves_time_for_the_rest():
    searched = 0.0

    def cost(now_s: float) -> float:
        nonlocal searched
        if now_s < searched + 0.25:
            return 1.5e-3
        searched = now_s
        return 30e-3

    device = Device(cost)
    run(4.0, device)
    assert device.share(0.5, 3.9) >= 0.8 * (1.0 - 30.0 / 250.0) / 1.5 * (1.0 - 0.2e-3 / SLICE_S)
    assert not device.load_shedding.behind


@pytest.mark.parametrize(("cost_ms", "share"), [(5.0, 1.0), (15.0, 1.0), (33.0, 0.5)])
def test_a_slow_device_has_the_time_that_its_frames_take(cost_ms: float, share: float):
    device = Device(1e-3 * cost_ms, rate_hz=60.0)
    run(20.0, device)
    assert device.share(2.0, 19.0) == pytest.approx(share, abs=0.03)


def test_a_device_whose_rate_is_not_known_is_followed():
    load_shedding = LoadShedding(0.0)
    load_shedding.count(1, 1.0, 1.0)
    assert load_shedding.choose([None] * 64, 10_000) == (True,) * 64


@given(
    st.lists(
        st.tuples(
            st.lists(st.sampled_from([None, 0, 1, 2, 7]), min_size=1, max_size=MOST),
            st.integers(0, 500),
            st.floats(0.0, 1.0),
            st.floats(0.0, 1.0),
        ),
        max_size=30,
    ),
    st.floats(0.1, 1e5),
)
def test_whatever_comes_something_is_answered(
    steps: list[tuple[list[int | None], int, float, float]], rate_hz: float
):
    load_shedding = LoadShedding(rate_hz)
    for slots, waiting, tracking_s, rest_s in steps:
        track = load_shedding.choose(slots, waiting)
        assert 1 <= len(track) <= len(slots)
        assert track[-1] or (load_shedding.behind and len(track) == len(slots))
        load_shedding.count(sum(track), tracking_s, rest_s)
