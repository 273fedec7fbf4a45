"""Camera configuration: lost cameras raise DeviceNotConnected, refusals InvalidParameter."""

from collections.abc import Callable
from typing import Any

import pytest

import hardware.genicam.camera
from compute.errors import InvalidParameter
from hardware.errors import DeviceNotConnected
from hardware.genicam.aravis import AravisError
from hardware.genicam.camera import Camera
from hardware.genicam.settings import Feature, GenicamCamera, GenicamSettings

WHICH = GenicamCamera("left", "Maker-Model-1")
SETTINGS = GenicamSettings(
    (WHICH,), 7.0, width=64, exposure_us=100.0, line_rate_hz=500.0, features=(Feature("Gain", 2),)
)
SETS_AND_READS = [
    "camera_set_pixel_format_from_string",
    "camera_set_acquisition_mode",
    "camera_set_exposure_time",
    "camera_set_integer",
    "camera_is_feature_available",
    "camera_get_float",
]


class PlayedLibrary:
    """Stands where Aravis does: a USB camera on which one call fails."""

    def __init__(self, failing: str, error: AravisError, *, stays: bool) -> None:
        self.calls: list[str] = []
        self._failing, self._error, self._stays = failing, error, stays
        self._failed = False

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*_: object) -> object:
            self.calls.append(name)
            if name == self._failing:
                self._failed = True
                raise self._error
            if self._failed and not self._stays and name != "unref":
                raise AravisError("gone", unanswered=True)
            return {
                "camera_new": 1,
                "camera_is_gv_device": 0,
                "camera_is_feature_available": 1,
                "camera_get_integer": 64,
                "camera_get_float": 500.0,
            }.get(name)

        return call


def made(monkeypatch: pytest.MonkeyPatch, library: PlayedLibrary) -> Camera:
    monkeypatch.setattr(hardware.genicam.camera, "library", lambda: library)
    return Camera(WHICH, SETTINGS)


def test_it_is_set_as_it_should_be(monkeypatch: pytest.MonkeyPatch) -> None:
    library = PlayedLibrary("nothing", AravisError(""), stays=True)
    camera = made(monkeypatch, library)
    assert (camera.width, camera.line_rate_hz) == (64, 500.0)
    assert set(SETS_AND_READS) <= set(library.calls)


@pytest.mark.parametrize("call", SETS_AND_READS)
def test_no_answer_is_a_camera_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    """Even if it answers the next question: a cable that was drawn for a moment."""
    library = PlayedLibrary(call, AravisError("write_memory timeout", unanswered=True), stays=True)
    with pytest.raises(DeviceNotConnected, match=r'sensor "left".*: write_memory timeout'):
        made(monkeypatch, library)


@pytest.mark.parametrize("call", SETS_AND_READS[:4])
def test_an_error_of_a_camera_that_does_not_answer_then_is_one_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    library = PlayedLibrary(call, AravisError("no such node"), stays=False)
    with pytest.raises(DeviceNotConnected, match="went away while it was set up"):
        made(monkeypatch, library)


@pytest.mark.parametrize("call", SETS_AND_READS[:3])
def test_a_camera_that_is_there_and_says_no_is_set_wrongly(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    library = PlayedLibrary(call, AravisError("not an entry"), stays=True)
    with pytest.raises(InvalidParameter, match=r"cannot be .*: not an entry"):
        made(monkeypatch, library)
