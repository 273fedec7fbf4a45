"""GenicamDriver with Aravis's fake GigE Vision camera in another process.

Skipped where Debian's aravis-tools and libaravis-0.8-0 are not installed.
"""

import ctypes
import itertools
import os
import shutil
import subprocess
import time
from collections.abc import Iterator

import numpy as np
import pytest

import hardware.genicam.driver
from compute.errors import InvalidParameter
from hardware.errors import DeviceNotConnected, MissingLibrary
from hardware.genicam.aravis import AravisError, library
from hardware.genicam.camera import Camera, cameras
from hardware.genicam.driver import GenicamDriver
from hardware.genicam.settings import Feature, GenicamCamera, GenicamSettings
from hardware.line_frame import LineFrame
from hardware.link import LinkState

PROGRAM = shutil.which("arv-fake-gv-camera-0.8")
UNPLUGS = int(os.environ.get("LUMILINE_TEST_UNPLUGS", "5"))
ADDRESS = "127.0.0.1"
HERE = (GenicamCamera("left", ADDRESS),)


def _why_not() -> str | None:
    try:
        library()
    except MissingLibrary as error:
        return error.detail
    return None if PROGRAM else "arv-fake-gv-camera-0.8 is not installed (Debian: aravis-tools)"


pytestmark = pytest.mark.skipif(_why_not() is not None, reason=str(_why_not()))


class FakeCamera:
    """The process; it can be killed and started again, as a cable is drawn."""

    def __init__(self, *options: str) -> None:
        self._options = options
        self.plug()

    def plug(self) -> None:
        assert PROGRAM is not None
        self._process = subprocess.Popen(
            [PROGRAM, "-i", ADDRESS, *self._options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def unplug(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def fake() -> Iterator[FakeCamera]:
    """One for all tests; it keeps what it is set to, as a camera does."""
    camera = FakeCamera()
    yield camera
    camera.unplug()


def opened(settings: GenicamSettings) -> GenicamDriver:
    """Open a driver; the camera's process may need a moment before it answers."""
    driver = GenicamDriver("bar", settings)
    for _ in range(20):
        try:
            driver.open()
        except DeviceNotConnected:
            time.sleep(0.1)
        else:
            return driver
    raise AssertionError("the fake camera did not start")


def taken(driver: GenicamDriver, count: int) -> list[LineFrame]:
    return list(itertools.islice(driver.frames(), count))


def changes(states: list[LinkState]) -> list[str]:
    """Return how often it went and came; a busy machine may find it silent beside that."""
    gone = [state.state == "disconnected" for state in states if state.state != "silent"]
    return [
        "disconnected" if now else "connected"
        for before, now in itertools.pairwise([False, *gone])
        if now != before
    ]


def test_cameras_are_listed_and_opened_by_identifier(fake: FakeCamera) -> None:
    opened(GenicamSettings(HERE, 7.0)).close()
    found = [entry for entry in cameras() if entry.address == ADDRESS]
    assert len(found) == 1
    assert (found[0].vendor, found[0].model, found[0].serial_number) == ("Aravis", "Fake", "GV01")
    by_name = GenicamSettings((GenicamCamera("left", found[0].camera),), 7.0, width=256)
    driver = opened(by_name)
    assert [sensor.pixels for sensor in driver.description.sensors] == [256]
    assert taken(driver, 1)[0].lines.shape == (1, 256)
    driver.close()


def test_lines_are_the_cameras_pattern_and_numbered(fake: FakeCamera) -> None:
    """Its picture moves by one pixel with each frame, and from line to line."""
    settings = GenicamSettings(HERE, 7.0, width=200, lines_per_buffer=4, line_rate_hz=400.0)
    driver = opened(settings)
    assert driver.description.frame_rate_hz == 400.0
    frames = taken(driver, 40)
    driver.close()
    numbers = [frame.sequence for frame in frames]
    assert numbers == sorted(set(numbers))
    first = {frame.sequence // 4: frame.lines[0] for frame in frames if frame.sequence % 4 == 0}
    assert len(first) == 10
    for frame in frames:
        buffer, row = divmod(frame.sequence, 4)
        if buffer + row in first:
            np.testing.assert_array_equal(frame.lines[0], first[buffer + row])
    assert (first[0] != first[1]).any()
    period_ns = np.median(np.diff([frame.exposure_device_ns for frame in frames]))
    assert period_ns == 2_500_000  # three of four come from one buffer, by the rate it states


def test_sixteen_bits(fake: FakeCamera) -> None:
    """This fake sends the high byte first, against the convention: a ramp after exchanging."""
    settings = GenicamSettings(HERE, 7.0, pixel_format="Mono16", width=128)
    driver = opened(settings)
    assert driver.description.bits == 16
    line = taken(driver, 1)[0].lines[0]
    driver.close()
    assert (np.diff(line.byteswap().astype(np.int64)) % 65535 == 1).all()


def test_host_times_are_those_of_the_host(fake: FakeCamera) -> None:
    driver = opened(GenicamSettings(HERE, 7.0, line_rate_hz=200.0, exposure_us=1000.0))
    begin_ns = time.time_ns()
    frames = taken(driver, 20)
    end_ns = time.time_ns()
    driver.close()
    exposed_ns = [frame.exposure_host_ns for frame in frames]
    assert begin_ns - 1_000_000 < min(exposed_ns)  # less the exposure
    assert max(exposed_ns) < end_ns


def test_a_trigger_by_its_features_and_silence(
    fake: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hardware.genicam.driver, "SILENCE_S", 0.1)
    trigger = (
        Feature("TriggerSelector", "FrameStart"),
        Feature("TriggerSource", "Software"),
        Feature("TriggerMode", "On"),
        Feature("GainRaw", 2),
    )
    driver = opened(GenicamSettings(HERE, 7.0, features=trigger))
    status: list[LinkState] = []

    def heard(state: LinkState) -> None:
        status.append(state)
        driver.close()

    driver.listen(heard)
    assert taken(driver, 1) == []
    assert [state.state for state in status] == ["silent"]
    assert status[0].reason is not None
    assert "it may wait for a trigger" in status[0].reason
    fake.unplug()
    fake.plug()  # without its trigger


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            GenicamSettings(HERE, 7.0, features=(Feature("NoSuchFeature", 1),)),
            r"camera 127\.0\.0\.1: feature \(its feature NoSuchFeature\) cannot be 1",
        ),
        (
            GenicamSettings(HERE, 7.0, pixel_format="Mono12p"),
            "pixel_format cannot be 'Mono12p': .*not an entry",
        ),
    ],
)
def test_what_the_camera_does_not_have_is_said(
    fake: FakeCamera, settings: GenicamSettings, message: str
) -> None:
    opened(GenicamSettings(HERE, 7.0)).close()
    driver = GenicamDriver("bar", settings)
    with pytest.raises(InvalidParameter, match=message):
        driver.open()
    opened(GenicamSettings(HERE, 7.0)).close()  # it was let go


def test_a_camera_that_another_program_holds_is_not_taken(fake: FakeCamera) -> None:
    driver = opened(GenicamSettings(HERE, 7.0))
    other = GenicamDriver("other", GenicamSettings(HERE, 7.0))
    with pytest.raises(DeviceNotConnected, match="another program"):
        other.open()
    assert len(taken(driver, 2)) == 2
    driver.close()


def test_two_cameras_make_one_device(fake: FakeCamera) -> None:
    """The second is Aravis's camera within the process; both run freely, so any two lines match."""
    ctypes.CDLL("libaravis-0.8.so.0").arv_enable_interface(b"Fake")
    both = (*HERE, GenicamCamera("right", "Fake_1"))
    driver = opened(GenicamSettings(both, 7.0, width=256, line_rate_hz=20.0, match_us=45_000.0))
    frames = taken(driver, 6)
    driver.close()
    assert {frame.lines.shape for frame in frames} == {(2, 256)}
    assert np.diff([frame.exposure_device_ns for frame in frames]).min() > 0
    assert np.diff([frame.sequence for frame in frames]).min() > 0


def test_lost_packets_are_counted(fake: FakeCamera) -> None:
    fake.unplug()
    camera = FakeCamera("-r", "300")
    try:
        driver = opened(GenicamSettings(HERE, 7.0, line_rate_hz=500.0))
        frames = taken(driver, 20)
        counters = driver.link().counters
        driver.close()
    finally:
        camera.unplug()
        fake.plug()
    assert counters.frames_garbled > 0
    assert frames[-1].sequence >= 20
    assert counters.frames_lost >= frames[-1].sequence - 19


def test_unplugged_and_connected_again_many_times(
    fake: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hardware.genicam.driver, "SILENCE_S", 0.1)
    monkeypatch.setattr("hardware.genicam.camera_stream.RETRY_S", (0.02,))
    driver = opened(GenicamSettings(HERE, 7.0, width=200, line_rate_hz=200.0))
    states: list[LinkState] = []
    driver.listen(states.append)
    frames = driver.frames()
    got = list(itertools.islice(frames, 3))
    for number in range(UNPLUGS):
        fake.unplug()
        fake.plug()
        while driver.link().counters.reconnects <= number:
            got.append(next(frames))
        got += itertools.islice(frames, 3)
    driver.close()
    assert changes(states) == ["disconnected", "connected"] * UNPLUGS
    sequence = [frame.sequence for frame in got]
    device = [frame.exposure_device_ns for frame in got]
    assert sequence == sorted(set(sequence))
    assert device == sorted(set(device))


def test_a_camera_that_goes_again_while_it_is_set_up_comes_back(
    fake: FakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody answers meanwhile: Aravis asks for seconds before it gives up."""
    monkeypatch.setattr(hardware.genicam.driver, "SILENCE_S", 0.1)
    monkeypatch.setattr("hardware.genicam.camera_stream.RETRY_S", (0.02,))
    driver = opened(GenicamSettings(HERE, 7.0, width=200, line_rate_hz=200.0))
    status: list[LinkState] = []
    cut: list[BaseException | None] = []
    set_up = Camera._set_up

    def cut_once(camera: Camera) -> None:
        if cut:
            return set_up(camera)
        fake.unplug()
        try:
            set_up(camera)
        except DeviceNotConnected as error:
            cut.append(error.__cause__)
            raise

    def heard(state: LinkState) -> None:
        status.append(state)
        if "went away while it was set up" in (state.reason or ""):
            fake.plug()

    driver.listen(heard)
    frames = driver.frames()
    next(frames)
    monkeypatch.setattr(Camera, "_set_up", cut_once)
    fake.unplug()
    fake.plug()
    while driver.link().counters.reconnects == 0:
        next(frames)
    driver.close()
    assert isinstance(cut[0], AravisError)
    assert cut[0].unanswered
    assert changes(status) == ["disconnected", "connected"]
    assert any("went away while it was set up" in (state.reason or "") for state in status)
