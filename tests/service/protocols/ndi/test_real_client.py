"""The package ndicapi, as software with an NDI driver uses it, over the network."""

import asyncio
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.application.app import create_app
from service.pipeline.frame_batch import LatestPoses
from service.settings import Settings
from tests.service.fake_pipeline import TestClient
from tests.service.protocols.ndi.fake_poses import PATIENT_S, answering, entry, pose

pytest.importorskip("ndicapy")

CLIENT = Path(__file__).with_name("real_client.py")


async def client_told(port: int, rom: Path | None = None) -> dict[str, Any]:
    """Return what a client that connects to a port is told."""
    arguments = [str(CLIENT), str(port), *([str(rom)] if rom else [])]
    client = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdout=-1, stderr=-1)
    out, err = await client.communicate()
    assert client.returncode == 0, err.decode()
    found: dict[str, Any] = json.loads(out)
    return found


def told(*poses: ToolPose, rom: Path | None = None, **options: Any) -> dict[str, Any]:
    """Return what the client was told."""

    async def run() -> dict[str, Any]:
        board = LatestPoses()
        board.put(entry(*poses))
        async with answering(board, **options) as server:
            return await client_told(server.address[1], rom)

    return asyncio.run(run())


def same(transform: list[float], given: ToolPose, unit: float, millimetre: float) -> bool:
    """Whether a transformation is the pose, within half of the last digits."""
    assert given.rotation is not None
    assert given.translation_mm is not None
    expected = Rotation.from_matrix(given.rotation).as_quat(canonical=True, scalar_first=True)
    assert np.abs(np.array(transform[:4]) - expected).max() <= unit
    assert np.abs(np.array(transform[4:7]) - given.translation_mm).max() <= millimetre
    # Square root of the variances 0.01, 0.04 and 0.09, together.
    assert abs(transform[7] - 0.14**0.5) <= unit
    return True


def test_two_tools():
    poses = {"probe": pose("probe", seed=1), "ref": pose("ref", seed=2)}
    found = told(*poses.values())
    assert found["tools"] == {"1": "probe", "2": "ref"}
    assert found["init"] == found["stop"] == "OKAY"
    assert "Freeze Tag: Lumiline" in found["ver"]
    assert "0x2b" in found["error"]
    for handle, tool in found["tools"].items():
        for reply, unit, millimetre in (("tx", 0.51e-4, 0.51e-2), ("bx", 1e-6, 1e-4)):
            transform, frame, status = found[reply][handle]
            assert same(transform, poses[tool], unit, millimetre)
            assert (frame, status) == (7, 0x31)
        assert same(found["more"][handle][0], poses[tool], 1e-6, 1e-4)
    assert found["tx_system"] == found["bx_system"] == 0


def test_a_tool_by_its_definition_file(tmp_path: Path):
    """It is the tool that the part number means, beside those that were there."""
    (rom := tmp_path / "8700340.rom").write_bytes(
        b"NDI".ljust(592, b"\0") + b"8700340".ljust(160, b"\0")
    )
    given = pose("probe", seed=3)
    found = told(
        given,
        pose("lost", PoseStatus.MISSING),
        pose("outside", PoseStatus.OUT_OF_VOLUME, seed=4),
        pose("poor", PoseStatus.HIGH_ERROR, seed=5),
        rom=rom,
        part_numbers={"8700340": "probe"},
    )
    handle = str(found["requested"])
    assert found["tools"][handle] == "probe"
    assert same(found["tx"][handle][0], given, 0.51e-4, 0.51e-2)
    by_tool = {tool: handle for handle, tool in found["tools"].items()}
    for reply in ("tx", "bx"):
        assert found[reply][by_tool["lost"]] == ["MISSING", 7, 0x31]
        assert found[reply][by_tool["poor"]] == ["MISSING", 7, 0x31]
        # The client asks for what is outside of the volume: 0800.
        assert found[reply][by_tool["outside"]][2] == 0x71
        assert len(found[reply][by_tool["outside"]][0]) == 8


TOOLS = {
    "probe": [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]],
    "ref": [[0, 0, 0], [110, 0, 0], [0, 70, 0], [45, 50, 30]],
}


@pytest.mark.slow
def test_two_tools_as_rest_has_them(tmp_path: Path):
    """A whole service, its tools made over REST, their poses asked for in both ways."""
    app = create_app(Settings(data_dir=tmp_path, compute_device="cpu", ndi_port=0))
    with TestClient(app) as client:
        app.state.ndi._feed._age_s = PATIENT_S
        # Its own frames would take the place of those that are put up here.
        assert client.post("/api/v1/devices/sim/stop").status_code == 200
        for number, (name, markers) in enumerate(TOOLS.items()):
            made = client.post(
                "/api/v1/tools",
                json={
                    "id": name,
                    "device_id": "sim",
                    "title": name,
                    "markers_mm": markers,
                    "strobe_markers": [4 * number + slot for slot in range(4)],
                },
            )
            assert made.status_code == 201, made.text
        poses = [pose(name, seed=10 + number) for number, name in enumerate(TOOLS)]
        rest: dict[str, Any] = {}
        while len(rest) < 2:
            # Over REST poses are good for a second, which a busy machine may need.
            now = [replace(one, exposure_ns=time.time_ns()) for one in poses]
            app.state.live.poses.put(entry(*now, device="sim"))
            found = [client.get(f"/api/v1/tools/{name}/pose").json() for name in TOOLS]
            rest = {one["tool_id"]: one for one in found if one["status"] == "OK"}
        heard = asyncio.run(client_told(app.state.ndi.address[1]))
    assert heard["tools"] == {"1": "probe", "2": "ref"}
    for handle, name in heard["tools"].items():
        expected = np.array(rest[name]["quaternion_wxyz"] + rest[name]["translation_mm"])
        for reply, unit, millimetre in (("tx", 0.51e-4, 0.51e-2), ("bx", 1e-6, 1e-4)):
            transform, frame, _ = heard[reply][handle]
            assert np.abs(transform[:4] - expected[:4]).max() <= unit
            assert np.abs(transform[4:7] - expected[4:]).max() <= millimetre
            assert frame == rest[name]["sequence"]
