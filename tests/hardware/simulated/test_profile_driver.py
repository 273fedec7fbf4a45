"""ProfileDriver: reproducible frames for every readout."""

import time
from dataclasses import replace
from threading import Event, Timer

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.profiles.profile_loader import load_profile, parse_profile, profile_names
from compute.optics.profiles.profile_optics import profile_optics
from compute.optics.profiles.profile_sections import LedMarkers
from compute.optics.stripe_optics import tabulated_optics
from compute.optics.stripe_optics.stripe_table import TableNodes
from compute.optics.stripe_optics.tabulated_optics import TableRequest, make_table
from hardware.driver import PreparingDriver
from hardware.line_frame import FrameFlag
from hardware.simulated.frame_batch import BATCH, Timing
from hardware.simulated.profile_driver import ProfileDriver, ProfileRenderer, readout_of
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import StillPoints
from hardware.simulated.tracing_process import TracingCancelled, table_in_process

BAR = load_profile("bar")
POINTS = ((-150.0, 40.0, 1400.0), (100.0, -60.0, 1600.0))
STILL = StillPoints(POINTS)


def settings_of(**changes):
    return ProfileSettings(**{"optics": "exact", "realtime": False, **changes})


def renderer(profile=BAR, **changes):
    settings = settings_of(**changes)
    timing = Timing(settings.rate_of(profile), settings.strobed_in(profile), None, False)
    return ProfileRenderer(profile, settings, timing)


def frames_of(profile=BAR, count=3, **changes):
    driver = ProfileDriver("one", profile, settings_of(**changes))
    driver.open()
    frames = []
    for frame in driver.frames():
        frames.append(frame)
        if len(frames) == count:
            driver.close()
    return driver.description, frames


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_gives_its_lines(name):
    profile = load_profile(name)
    description, frames = frames_of(profile, count=2)
    assert description.readout in ("lines", "coded-window", "gray-tracks")
    for frame in frames:
        assert frame.lines.shape == (len(profile.sensors), profile.pixels.count)
        assert frame.lines.dtype == np.uint16
        assert frame.lines.max() < 2**profile.detector.bits
        assert not frame.lines.flags.writeable
    # The marker in the middle of the volume is seen: light is far above the noise somewhere.
    detector = profile.detector
    noise = detector.read_noise_electrons / detector.electrons_per_count + 1.0
    assert frames[0].lines.max() > np.median(frames[0].lines) + 8.0 * noise


def test_readouts():
    kinds = {name: readout_of(load_profile(name)) for name in profile_names()}
    assert set(kinds.values()) == {"lines", "coded-window", "gray-tracks"}
    assert kinds["bar"] == "lines"
    assert kinds["mitchelson-1971"] == "gray-tracks"
    assert kinds["coda-mpx30"] == "coded-window"


@pytest.mark.slow
def test_same_bits_in_whatever_order():
    numbers = [3, 0, 2, 0, 3]
    first, second = renderer(scene=STILL), renderer(scene=STILL)
    forward = {number: second.batch(number) for number in range(4)}
    for number in numbers:
        batch = first.batch(number)
        np.testing.assert_array_equal(batch.lines, forward[number].lines)
        np.testing.assert_array_equal(batch.saturated, forward[number].saturated)
    assert (forward[0].lines != forward[1].lines).any()


@pytest.mark.slow
def test_seeds():
    still = {"scene": STILL, "illumination": "simultaneous"}
    same, other = renderer(**still, seed=5), renderer(**still, seed=6)
    pattern = renderer(**still, seed=5, pattern_seed=9)
    lines = same.batch(0).lines
    np.testing.assert_array_equal(lines, renderer(**still, seed=5).batch(0).lines)
    assert (lines != other.batch(0).lines).any()
    # The light is that of the points, whatever the seeds; the pixels' differences are not.
    sequence = np.arange(BATCH)
    np.testing.assert_array_equal(
        same.signal_electrons(sequence), pattern.signal_electrons(sequence)
    )
    # Pixels whose offsets differ by 5 counts, far more than the noise of an exposure.
    uneven = replace(BAR, detector=replace(BAR.detector, offset_nonuniformity_counts=5.0))
    one, two, other = (
        renderer(uneven, scene=STILL, seed=seed, pattern_seed=number).batch(0).lines.astype(float)
        for seed, number in ((5, 1), (6, 1), (5, 2))
    )
    assert np.std(one[0] - two[0]) < 3.0
    assert np.std(one[0] - other[0]) > 5.0


def test_strobed_markers_take_turns():
    _, frames = frames_of(scene=STILL, illumination="strobed", count=6)
    assert [frame.marker for frame in frames] == [0, 1, 0, 1, 0, 1]
    _, together = frames_of(scene=STILL, illumination="simultaneous", count=2)
    assert [frame.marker for frame in together] == [None, None]
    strobed = renderer(scene=STILL, illumination="strobed").signal_electrons(np.arange(2))
    both = renderer(scene=STILL, illumination="simultaneous").signal_electrons(np.arange(2))
    np.testing.assert_allclose(strobed[0] + strobed[1], both[0], rtol=1e-12)
    brightest = strobed.argmax(axis=2)
    assert (brightest[0] != brightest[1]).all()


def test_rate_above_the_device_is_refused():
    fastest = BAR.rates.line_rate_hz
    with pytest.raises(InvalidParameter, match=r"frame_rate_hz is 1001.0; bar reads at most 1000"):
        ProfileDriver("one", BAR, settings_of(frame_rate_hz=fastest + 1.0))
    description, _ = frames_of(count=1, frame_rate_hz=fastest)
    assert description.frame_rate_hz == fastest


def test_duration_and_close_end_it():
    driver = ProfileDriver("one", BAR, settings_of(duration_s=0.012))
    driver.open()
    assert len(list(driver.frames())) == 12
    _, frames = frames_of(count=2)
    assert len(frames) == 2


def test_saturated_frames_are_flagged():
    _, dim = frames_of(scene=STILL, count=1)
    assert dim[0].flags == FrameFlag.NONE
    # A gain at which the converter ends before the full well does.
    glaring = replace(
        BAR,
        markers=replace(BAR.markers, radiant_intensity_w_per_sr=25.0),
        detector=replace(BAR.detector, electrons_per_count=20.0),
    )
    _, bright = frames_of(glaring, scene=STILL, count=1)
    assert bright[0].flags == FrameFlag.SATURATED
    assert bright[0].lines.max() == 2**BAR.detector.bits - 1


def test_retroreflectors_shine_at_once():
    from importlib import resources

    text = (resources.files("compute.optics.profiles") / "devices" / "bar.toml").read_text()
    head, rest = text.split("[markers]")
    rest = rest[rest.index("[rates]") :].split("[assumed]")[0]
    markers = """[markers]
kind = "retro"
illuminator_intensity = "20 W/sr"
illuminator_position = ["0 mm", "0 mm", "0 mm"]
wavelength = "880 nm"
spectral_width = "50 nm"
retroreflection = "300 1/sr"
observation_half_angle = "10 deg"
half_angle = "30 deg"
diameter = "10 mm"
max_markers = 8

"""
    profile = parse_profile(head + markers + rest, "retro")
    description, frames = frames_of(profile, count=2, scene=STILL)
    assert description.markers == 0
    assert [frame.marker for frame in frames] == [None, None]
    signal = renderer(profile, scene=STILL).signal_electrons(np.arange(1))
    led = renderer(scene=STILL, illumination="simultaneous").signal_electrons(np.arange(1))
    assert (signal.sum(axis=2) > 0.0).all()
    # A marker of 10 mm is drawn out over more pixels than an emitter of 0.3 mm.
    lit = [(lines > 0.1 * lines.max(axis=2, keepdims=True)).sum() for lines in (signal, led)]
    assert lit[0] > 2 * lit[1]


@pytest.mark.slow
def test_tables_show_what_exact_rays_show():
    alike = replace(
        BAR, detector=replace(BAR.detector, response_nonuniformity=0.0, dark_nonuniformity=0.0)
    )
    show = {"scene": STILL, "illumination": "simultaneous"}
    exact, tables = renderer(alike, **show), renderer(alike, **show, optics="tabulated")
    signal, other = (one.signal_electrons(np.arange(1)) for one in (exact, tables))
    np.testing.assert_allclose(other.sum(axis=2), signal.sum(axis=2), rtol=1e-3)
    detector = alike.detector
    unlit = alike.rates.exposure_s * (
        detector.ambient_electrons_per_s + detector.dark_current_electrons_per_s
    )
    gain = detector.electrons_per_count
    variance = signal[0] + unlit + detector.read_noise_electrons**2 + gain**2 / 12.0
    peak = signal[0].max(axis=1, keepdims=True)
    assert np.abs((other - signal)[0] / peak).max() < 0.01
    # The light of the one's frames is what the other predicts.
    frames = gain * (exact.batch(0).lines - detector.offset_counts) - unlit
    excess = frames.mean(axis=0).sum(axis=1) - other[0].sum(axis=1)
    error = np.sqrt(variance.sum(axis=1) / BATCH)
    assert (np.abs(excess) < 5.0 * error).all()
    # ... and so is their place, within the noise of a centre of gravity of lit pixels.
    lit = other[0] > 0.0
    place = np.arange(lit.shape[1])
    moment = ((frames.mean(axis=0) - other[0]) * lit * place).sum(axis=1)
    moment -= ((frames.mean(axis=0) - other[0]) * lit).sum(axis=1) * place.mean()
    spread = np.sqrt((variance * lit * (place - place.mean()) ** 2).sum(axis=1) / BATCH)
    assert (np.abs(moment) < 5.0 * spread).all()


def test_the_rate_is_one_that_a_host_follows() -> None:
    rates = {
        name: ProfileSettings().rate_of(load_profile(name))
        for name in ("optotrak", "coda-mpx30", "thesis-5.9")
    }
    assert rates == {"optotrak": 1000.0, "coda-mpx30": 100.0, "thesis-5.9": 30.0}


def test_a_full_well_below_full_scale_is_saturated() -> None:
    """The bar's wells hold 4040 of 4095 counts: light that fills them is flagged."""
    bar = load_profile("bar")
    assert isinstance(bar.markers, LedMarkers)
    bright = replace(bar, markers=replace(bar.markers, radiant_intensity_w_per_sr=1.0))
    still = ProfileSettings(
        scene=StillPoints(((0.0, 0.0, 1500.0),)), optics="exact", realtime=False, duration_s=0.003
    )
    for profile, flags in ((bar, FrameFlag.NONE), (bright, FrameFlag.SATURATED)):
        driver = ProfileDriver("bar", profile, still)
        driver.open()
        frame = next(driver.frames())
        assert frame.lines.max() < 4095
        assert frame.flags == flags


def test_how_its_peaks_are_measured():
    for peaks in ("fit", "centroid"):
        description, _ = frames_of(count=1, peaks=peaks)
        assert (description.peaks, description.profile) == (peaks, "bar")
        # Traced lines are of another width at every place.
        assert description.line_sigma_px is None
    with pytest.raises(InvalidParameter, match="peaks is 'median'; it must be one of fit"):
        settings_of(peaks="median")


# Tracing in a process of its own


@pytest.fixture
def request_of_bar(monkeypatch) -> TableRequest:
    """The table of the profile bar, coarse: made in tenths of a second."""
    asked = []

    def note(request):
        asked.append(replace(request, nodes=TableNodes(7, 4, 4)))
        raise InterruptedError

    monkeypatch.setattr(tabulated_optics, "_tables", {})
    with pytest.raises(InterruptedError):
        profile_optics(BAR, "tabulated", note)
    return asked[0]


@pytest.mark.slow
def test_table_of_another_process_is_the_same(request_of_bar):
    other, own = table_in_process(request_of_bar, Event()), make_table(request_of_bar)
    points = np.array([(0.0, 0.0, 1500.0), (50.0, -20.0, 1400.0)])
    for one, two in zip(other(points), own(points), strict=True):
        np.testing.assert_array_equal(one, two)


def test_tracing_ends_when_the_device_is_closed(request_of_bar):
    closed = Event()
    Timer(0.3, closed.set).start()
    began = time.monotonic()
    with pytest.raises(TracingCancelled):
        table_in_process(replace(request_of_bar, nodes=TableNodes(201, 201, 41)), closed)
    assert time.monotonic() - began < 10.0


def test_live_driver_says_that_it_traces_and_does_so_elsewhere(monkeypatch, request_of_bar):
    traced = []

    def elsewhere(request, cancelled):
        traced.append(driver.preparation)
        assert not cancelled.is_set()
        return make_table(replace(request, nodes=request_of_bar.nodes))

    monkeypatch.setattr("hardware.simulated.profile_driver.table_in_process", elsewhere)
    settings = settings_of(optics="tabulated", realtime=True, frame_rate_hz=100, scene=STILL)
    driver = ProfileDriver("one", BAR, settings)
    assert isinstance(driver, PreparingDriver)
    driver.open()
    assert "are being traced" in driver.preparation
    frame = next(driver.frames())
    assert (frame.sequence, driver.preparation) == (0, None)
    driver.close()
    assert all("are being traced" in said for said in traced)
    assert traced


def test_driver_that_is_closed_while_it_traces_gives_no_frames(monkeypatch):
    def closed(_request, cancelled):
        driver.close()
        assert cancelled.is_set()
        raise TracingCancelled

    monkeypatch.setattr(tabulated_optics, "_tables", {})
    monkeypatch.setattr("hardware.simulated.profile_driver.table_in_process", closed)
    driver = ProfileDriver("one", BAR, settings_of(optics="tabulated", realtime=True))
    driver.open()
    assert list(driver.frames()) == []
    assert driver.preparation is None
