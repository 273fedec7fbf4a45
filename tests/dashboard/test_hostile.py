"""What no server ought to send is shown as text, and breaks nothing."""

import math
from typing import TYPE_CHECKING, Any

import msgpack
import pytest

from tests.dashboard.conftest import Visit

if TYPE_CHECKING:
    from playwright.sync_api import WebSocketRoute

pytestmark = pytest.mark.slow

MARKUP = "<img src=x onerror=\"document.title='broken'\">"
TRACKS = 10_000
FAR_OFF_NS = 4_000_000_000_000_000_000
"""In the year 2096."""
HELLO: dict[str, Any] = {
    "type": "hello", "version": 1, "device_id": "sim", "content": [], "mode": "live",
    "stream": "x", "next": 0, "resumed": False, "sensors": [MARKUP], "frame_rate_hz": None,
    "markers": None, "readout": None, "method": None, "state": "running", "reason": MARKUP,
    "link": None, "calibration_id": None, "holds": None, "radiometric_id": None,
}  # fmt: skip


def track(number: int) -> dict[str, Any]:
    """Return a track; every third has no number where numbers belong."""
    value = math.nan if number % 3 == 0 else float(number % 500)
    return {
        "id": number, "marker": None, "state": "confirmed", "flags": [MARKUP],
        "position_mm": [value, value, 1500.0], "velocity_mm_s": [value, 0.0, math.inf],
        "covariance_mm2": [[value, 0.0, 0.0], [0.0, value, 0.0], [0.0, 0.0, value]],
        "velocity_covariance_mm2_s2": None, "acceleration_mm_s2": None, "peaks": [],
        "nis": None, "dof": 0,
    }  # fmt: skip


def pose(tool: str) -> dict[str, Any]:
    """Return the pose of a tool that is not seen."""
    return {
        "tool_id": tool, "status": MARKUP, "reason": MARKUP, "translation_mm": None,
        "rotation": None, "quaternion_wxyz": None, "covariance": None, "tip_mm": None,
        "tip_covariance_mm2": None, "residual_sigma": math.nan, "markers_used": 0,
        "readings_used": 0, "velocity_mm_s": None, "angular_velocity_rad_s": None,
        "detectable_sigma": math.nan, "external_tip_mm": None, "external_rotation_rad": None,
    }  # fmt: skip


def frame(number: int) -> dict[str, Any]:
    """Return a message with far too much in it."""
    return {
        "type": "frame", "n": number, "device_id": "sim", "sequence": number,
        "exposure_ns": FAR_OFF_NS - number, "device_ns": 0, "marker": None,
        "calibration_id": None, "table_id": None, "radiometric_id": None, "flags": [],
        "points": [], "tracks": [track(one) for one in range(TRACKS)], "tools": [pose(MARKUP)],
    }  # fmt: skip


@pytest.mark.timeout(900)  # it draws without a graphics card
def test_ten_thousand_tracks_nan_and_markup_break_nothing(visit: Visit):
    messages = [msgpack.packb(one) for one in (HELLO, frame(0), frame(1))]

    def serve(socket: "WebSocketRoute") -> None:
        for message in messages:
            socket.send(message)

    page = visit.page
    page.route_web_socket("**/api/v1/stream*", serve)
    page.goto(f"{visit.url}/#/scene")
    page.reload()
    tracks = page.get_by_role("region", name="Tracks").last
    tracks.get_by_text(f"and {TRACKS - 200} more").wait_for()
    assert "NaN" not in tracks.inner_text()
    assert "track 1" in tracks.inner_text()
    tools = page.get_by_role("region", name="Tools").last
    assert MARKUP in tools.inner_text()
    assert page.title() == "Scene – Lumiline"
    tracks.get_by_role("button", name="track 1", exact=True).click()
    page.get_by_role("button", name="Top").click()
    visit.screen("Health")
    page.get_by_role("heading", name="Devices and links").wait_for()
