"""WriterProcessClient: acknowledged frames are safe, lost frames are counted."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hardware.recording.layout import unfinished_path
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.recording.writer_process.client import WRITER_DIED, WriterProcessClient
from hardware.recording.writer_process.job import DOCUMENT, WriterJob
from hardware.recording.writer_process.process import ORPHANED
from tests.hardware.recording.blocks import (
    assert_same_block,
    block,
    described,
    joined,
    read_recording,
)

FLUSH_S = 0.02
KILLS = int(os.environ.get("LUMILINE_TEST_KILLS", "2"))


def job(path: Path, **changes: Any) -> WriterJob:
    made = WriterJob(path, described(), True, True, {}, flush_s=FLUSH_S, ring_bytes=2**20)
    return replace(made, **changes)


def put(feed: WriterProcessClient, first: int, frames: int) -> bool:
    one = block(first, frames, calibration_row=0)
    return feed.put(one.rows, list(one.lines), one.peaks, one.points, 7)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 240.0
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


def check_frames(path: Path, frames: int) -> None:
    """Every bit of that many frames from the first on is in the file."""
    expected = block(0, frames, calibration_row=0)
    with RecordingReader(path) as reader:
        assert_same_block(reader.block(0, frames), expected)
        assert reader.info.frames == frames
        if frames:
            assert reader.active_calibration(0) == (b'{"id": "c"}', b"table" * 1000)


def feed_at_random(feed: WriterProcessClient, seconds: float, rng: np.random.Generator) -> None:
    """Hand over small and large blocks, all of which find room."""
    end, first = time.monotonic() + seconds, 0
    feed.put_active_calibration(lambda: (b'{"id": "c"}', b"table" * 1000))
    while time.monotonic() < end:
        size = int(rng.integers(1, 40))
        if put(feed, first, size):
            first += size
        time.sleep(float(rng.uniform(0.0, 0.002)))


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_writer_that_is_killed_at_any_moment_loses_nothing_acknowledged(
    tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng([seed, int(time.time())])
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    feed_at_random(feed, rng.uniform(0.0, 0.5), rng)
    unfinished_path(path, feed.pid).touch()  # as of one that is killed while it makes the file
    feed.kill()
    assert feed.wait(240.0)
    acknowledged = feed.status.state.frames
    assert (feed.status.ended, feed.status.failed) == (WRITER_DIED, True)
    assert list(tmp_path.iterdir()) == [path]
    info = read_recording(path)
    assert not info.complete
    assert info.frames >= acknowledged
    check_frames(path, info.frames)
    assert not put(feed, 10**6, 1)


FEEDER = """
import sys, time
from pathlib import Path
import numpy as np
from tests.hardware.recording.writer_process import test_client as client
feed = client.WriterProcessClient(client.job(Path(sys.argv[1])))
print(feed.pid, flush=True)
client.feed_at_random(feed, 60.0, np.random.default_rng(1))
"""


@pytest.mark.slow
def test_a_program_that_is_killed_leaves_all_that_it_handed_over(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with subprocess.Popen(
        [sys.executable, "-c", FEEDER, str(path)], stdout=subprocess.PIPE
    ) as feeder:
        assert feeder.stdout is not None
        writer = int(feeder.stdout.readline())
        with RecordingReader(path) as reader:
            wait_for(lambda: reader.refresh().frames > 200)
            before = reader.info.frames
        feeder.kill()
    wait_for(lambda: not _runs(writer))
    info = read_recording(path)
    assert (info.complete, info.state.reason) == (False, ORPHANED)
    assert info.frames >= before
    check_frames(path, info.frames)


def test_a_program_that_is_killed_within_a_calibration_leaves_what_came_before(
    tmp_path: Path,
) -> None:
    """A calibration may be larger than the pipe that it is sent by."""
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    feed.put_active_calibration(lambda: (b'{"id": "c"}', b"table" * 1000))
    assert put(feed, 0, 40)
    wait_for(lambda: feed.status.state.frames == 40)
    whole = DOCUMENT.pack(100_000, 9) + b"x" * 100_009
    feed._sender.send(lambda: whole[:65_536])
    one = block(40, 10, calibration_row=1)
    assert feed.put(one.rows, list(one.lines), one.peaks, one.points)
    feed._sender.close()
    assert feed.wait(240.0)
    info = read_recording(path)
    assert (info.complete, info.state.reason) == (False, ORPHANED)
    assert info.state.active_calibrations == 1
    check_frames(path, 40)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").split()[2]


def test_a_writer_that_does_not_keep_up_costs_frames_that_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    feed.put_active_calibration(lambda: (b"{}", b""))
    os.kill(feed.pid, signal.SIGSTOP)
    try:
        begin = time.monotonic()
        kept = [first for first in range(0, 40_000, 40) if put(feed, first, 40)]
        slowest = time.monotonic() - begin
    finally:
        os.kill(feed.pid, signal.SIGCONT)
    assert slowest < 20.0  # a thousand blocks, none of which waited
    assert 0 < len(kept) < 1000
    assert feed.dropped_frames == 40_000 - 40 * len(kept)
    wait_for(lambda: feed.status.tail > 0)
    assert put(feed, 40_000, 40)
    feed.stop("enough")
    assert feed.wait(240.0)
    state = read_recording(path).state
    assert (state.complete, state.reason, state.dropped_compute) == (True, "enough", 7)
    assert state.dropped_writer == state.missing == feed.dropped_frames
    with RecordingReader(path) as reader:
        expected = joined([block(first, 40, calibration_row=0) for first in [*kept, 40_000]])
        assert_same_block(reader.block(0, 10**6), expected)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_writer_at_a_signal_to_all_processes_goes_on(
    tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "r.h5"
    before = signal.signal(number, signal.SIG_DFL)  # it could be ignored here, as under nohup
    try:
        feed = WriterProcessClient(job(path))
    finally:
        signal.signal(number, before)
    os.kill(feed.pid, number)
    feed.put_active_calibration(lambda: (b'{"id": "c"}', b"table" * 1000))
    assert put(feed, 0, 40)
    feed.stop("enough")
    assert feed.wait(240.0)
    assert (feed.status.ended, feed.status.failed) == ("enough", False)
    check_frames(path, 40)


def test_the_end_is_told_whatever_is_told_behind_it(tmp_path: Path) -> None:
    """Frames that are being handed over while another thread stops it tell of the head later."""
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    os.kill(feed.pid, signal.SIGSTOP)
    try:
        feed.stop("enough")
        wait_for(lambda: feed._stop_sent)
        feed._send_head()
    finally:
        os.kill(feed.pid, signal.SIGCONT)
    assert feed.wait(240.0)
    assert feed.status.ended == read_recording(path).state.reason == "enough"


def test_a_writer_that_lives_touches_the_file_without_frames(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    begin = path.stat().st_mtime_ns
    wait_for(lambda: path.stat().st_mtime_ns > begin)
    feed.stop("enough")
    assert feed.wait(240.0)
    assert read_recording(path).frames == 0


@pytest.mark.parametrize(
    ("limit", "reason", "frames"),
    [
        ({"seconds": 0.25}, "the limit of 0.25 s", 250),
        ({"size_bytes": 100_000}, "the limit of 100000 bytes", None),
        ({"free_bytes": 2**62}, "free space: ", None),
    ],
)
def test_limits_end_it_with_the_reason(
    tmp_path: Path, limit: dict[str, Any], reason: str, frames: int | None
) -> None:
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path, **limit))
    feed.put_active_calibration(lambda: (b'{"id": "c"}', b"table" * 1000))
    first = 0
    while not feed.ended and first < 100_000:
        first += 30 if put(feed, first, 30) else 0
        time.sleep(0.001)
    assert feed.wait(240.0)
    info = read_recording(path)
    assert info.complete
    assert info.state.reason.startswith(reason)
    assert feed.status.ended == info.state.reason
    assert not feed.status.failed
    assert info.frames == frames or frames is None
    if "size_bytes" in limit:
        # The file is larger than its frames; it ends with the block that reaches the limit.
        one = block(0, 30, calibration_row=0)
        parts = (one.rows, one.lines, one.peaks, one.points)
        frame_bytes = sum(part.nbytes for part in parts if part is not None) / 30
        assert max(info.frames * frame_bytes, path.stat().st_size) >= limit["size_bytes"]
        assert (info.frames - 30) * frame_bytes < limit["size_bytes"]


def test_a_full_disk_fails_it_and_leaves_what_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    feed = WriterProcessClient(job(path))
    feed.put_active_calibration(lambda: (b'{"id": "c"}', b"table" * 1000))
    assert put(feed, 0, 300)
    wait_for(lambda: feed.status.state.frames == 300)
    # What a full disk is to a process: no file grows any more.
    size = path.stat().st_size
    resource.prlimit(feed.pid, resource.RLIMIT_FSIZE, (size, size))
    first = 300
    while not feed.ended:
        first += 40 if put(feed, first, 40) else 0
        time.sleep(0.001)
    assert feed.wait(240.0)
    assert feed.status.failed
    assert feed.status.ended is not None
    assert feed.status.ended.startswith("the file cannot be written: ")
    info = read_recording(path)
    assert not info.complete
    assert info.frames >= 300
    check_frames(path, info.frames)


MAKER = """
import resource, sys
from pathlib import Path
from hardware.recording.writer_process.process import _reason
from tests.hardware.recording.writer_process.test_client import RecordingWriter, described
for room in map(int, sys.argv[2:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    try:
        RecordingWriter(Path(sys.argv[1]), described())
    except (OSError, RuntimeError) as error:
        print(_reason(error), flush=True)
"""


def test_a_disk_without_room_for_a_file_is_left_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with RecordingWriter(path, described()):
        made = path.stat().st_size
    path.unlink()
    rooms = [str(room) for room in (0, 1, made // 4, made // 2)]
    # In a program of its own: the file library keeps what it could not write.
    found = subprocess.run(
        [sys.executable, "-c", MAKER, str(path), *rooms],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=False,
    )
    assert found.stdout.splitlines() == ["File too large"] * len(rooms)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_made_is_told_at_once(tmp_path: Path) -> None:
    existing = tmp_path / "r.h5"
    shutil.copy(__file__, existing)
    with pytest.raises(OSError, match=r"r\.h5: File exists"):
        WriterProcessClient(job(existing))
    assert existing.read_bytes() == Path(__file__).read_bytes()
