"""MissingLibrary without Aravis; the library is loaded lazily."""

import subprocess
import sys

import pytest

import hardware.genicam.aravis
from hardware.errors import MissingLibrary
from hardware.genicam.driver import GenicamDriver
from hardware.genicam.settings import GenicamCamera, GenicamSettings


def test_what_is_missing_is_said_when_a_camera_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    names = dict.fromkeys(("linux", "darwin", "win32"), "libaravis-none.so.0")
    monkeypatch.setattr(hardware.genicam.aravis, "_NAMES", names)
    hardware.genicam.aravis.library.cache_clear()
    driver = GenicamDriver("bar", GenicamSettings((GenicamCamera("x", "10.0.0.5"),), 7.0))
    with pytest.raises(MissingLibrary, match=r"apt-get install libaravis-0\.8-0"):
        driver.open()
    driver.close()
    hardware.genicam.aravis.library.cache_clear()


def test_a_library_that_is_too_old_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware.genicam.aravis, "_PLAIN", {"arv_no_such_call": (None, ())})
    monkeypatch.setattr(hardware.genicam.aravis, "CDLL", lambda _: _Empty())
    hardware.genicam.aravis.library.cache_clear()
    with pytest.raises(MissingLibrary, match="no such symbol"):
        hardware.genicam.aravis.library()
    hardware.genicam.aravis.library.cache_clear()


class _Empty:
    def __getitem__(self, name: str) -> object:
        raise AttributeError(f"no such symbol: {name}")


def test_importing_the_driver_loads_no_library() -> None:
    program = (
        "import hardware.genicam.driver\n"
        "maps = open('/proc/self/maps').read()\n"
        "raise SystemExit('aravis' in maps.replace('genicam/aravis', ''))"
    )
    if not sys.platform.startswith("linux"):
        pytest.skip("reads /proc")
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
