"""Recordings and captured streams as motion tables: what was live, again."""

import json
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.errors import InvalidParameter, InvalidRecording
from compute.pose.rigid_body import RigidBody
from hardware.line_frame import LineFrame
from hardware.recording.frame_block import FrameBlock, frame_rows
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.devices.tracking_settings import Tracking
from service.api.exports.from_recording import table_from_recording
from service.api.exports.from_stream import table_from_stream
from service.api.exports.table_builder import TableBuilder
from service.api.recordings.active_calibration_file import dump_active_calibration
from service.api.recordings.result_rows import peak_rows, point_rows
from service.cli.json_files import DOCUMENT
from service.cli.tracking_files import read_device
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.tracking_config import TrackingConfig
from service.protocols.stream.messages import StreamBatch, encode
from tests.service.api.exports.readers import read_sequence, read_trc
from tests.service.cli.test_commands import here, nominal_document
from tests.service.pipeline.test_pipeline_manager import nominal

MARKERS = ((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 80.0, 10.0), (-40.0, 30.0, 50.0))
SCENE = MovingTools((MovingTool(MARKERS),))
SETTINGS = SimulationSettings(
    SCENE, frame_rate_hz=400.0, illumination="simultaneous", duration_s=0.2, realtime=False
)
PROBE = RigidBody("probe", np.array(MARKERS), None, (0.0, -100.0, 0.0))
FRAMES = 80


class Taken:
    """What a simulated device gave live, in batches of ten."""

    def __init__(self) -> None:
        driver = SimulatedDriver("sim", SETTINGS)
        driver.open()
        self.description = driver.description
        self.frames = list(islice(driver.frames(), FRAMES))
        self.calibration = ActiveCalibration("c1", nominal())
        processor = FrameProcessor("sim", self.description, "cpu")
        processor.set_calibration(ActiveCalibration("c1", self.calibration.calibration))
        processor.set_tracking_config(TrackingConfig(tracks=True, tools=(PROBE,)))
        self.batches = [
            processor.process(self.frames[first : first + 10]) for first in range(0, FRAMES, 10)
        ]
        builder = TableBuilder("sim", 400.0, ["probe"])
        for batch in self.batches:
            builder.add(batch)
        self.table = builder.build()


@pytest.fixture(scope="module")
def taken() -> Taken:
    return Taken()


def recording(path: Path, taken: Taken, *, lines: bool, results: bool) -> Path:
    with RecordingWriter(path, taken.description, lines=lines, results=results) as writer:
        writer.put_active_calibration(*dump_active_calibration(taken.calibration))
        for batch in taken.batches:
            writer.append_block(block(batch, batch.frames, lines=lines, results=results))
    return path


def block(
    batch: FrameBatch, frames: tuple[LineFrame, ...], *, lines: bool, results: bool
) -> FrameBlock:
    rows = frame_rows(frames)
    rows["active_calibration"] = 0
    peaks, of_peaks = peak_rows(batch.peaks, len(batch.sensor_names))
    points, of_points = point_rows(batch)
    rows["peaks"], rows["points"] = (of_peaks, of_points) if results else (0, 0)
    return FrameBlock(
        rows,
        np.stack([frame.lines for frame in frames]) if lines else None,
        peaks if results else peaks[:0],
        points if results else points[:0],
    )


def same(found: Any, expected: Any, without: tuple[str, ...] = ()) -> None:
    for field in fields(expected):
        one, two = getattr(found, field.name), getattr(expected, field.name)
        if field.name in without:
            continue
        if field.name in ("points", "tracks", "poses"):
            same(one, two)
        elif isinstance(two, np.ndarray):
            assert np.array_equal(one, two, equal_nan=two.dtype.kind == "f"), field.name
        else:
            assert one == two, field.name


@pytest.mark.parametrize(("lines", "results"), [(True, True), (True, False), (False, True)])
def test_a_recording_gives_what_was_live(
    taken: Taken, tmp_path: Path, lines: bool, results: bool
) -> None:
    """Bit by bit, tracks and poses too; from the recorded peaks, or from the lines."""
    path = recording(tmp_path / "r.h5", taken, lines=lines, results=results)
    seen: list[int] = []
    with RecordingReader(path) as reader:
        found = table_from_recording(reader, (PROBE,), done=seen.append)
    same(found, taken.table, ("notes",))
    assert found.notes == {"calibration": "c1"}
    assert seen[-1] == FRAMES == len(found)
    assert len(set(found.tracks.identity.tolist())) >= 4
    assert (found.poses.status == "OK").sum() > FRAMES // 2


@pytest.mark.slow
def test_tracking_and_limits_that_are_not_the_defaults(taken: Taken, tmp_path: Path) -> None:
    """As live, bit by bit; and otherwise than by default, or nothing would be shown."""
    tracking = Tracking(tracks="always", tool_coast_s=0.02, volume_mm=((0, 0, 0), (1, 1, 1)))
    strict = replace(PROBE, max_tip_sd_mm=1e-4)
    processor = FrameProcessor("sim", taken.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", taken.calibration.calibration))
    live = TrackingConfig(True, (strict,), tracking.tracker(), tracking.tool_tracker())
    processor.set_tracking_config(live)
    builder = TableBuilder("sim", 400.0, ["probe"])
    for first in range(0, FRAMES, 10):
        builder.add(processor.process(taken.frames[first : first + 10]))
    source = recording(tmp_path / "r.h5", taken, lines=False, results=True)
    with RecordingReader(source) as reader:
        found = table_from_recording(reader, (strict,), tracking=tracking)
    same(found, builder.build(), ("notes",))
    assert "OK" not in found.poses.status
    (tools := tmp_path / "tools.json").write_text(
        json.dumps([{"id": "probe", "markers_mm": MARKERS, "tip_mm": [0, -100, 0]}])
    )
    (device := tmp_path / "device.json").write_text(
        json.dumps({"id": "sim", "title": "x", "tracking": tracking.model_dump(mode="json")})
    )
    for option, statuses in (((), {"OK"}), (("--device-file", device), {"OUT_OF_VOLUME"})):
        to = tmp_path / f"{len(option)}.csv"
        here("export", source, "--output", to, "--tools", tools, *option)
        told = {line.split(",")[7] for line in to.read_text().splitlines() if ",tool," in line}
        assert statuses <= told
        assert not ({"OK", "OUT_OF_VOLUME"} - statuses) & told


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"id": "sim"}', '{"id": "sim", "tracking": {"x": 1}}']
)
def test_what_is_no_device(tmp_path: Path, text: str) -> None:
    (path := tmp_path / "device.json").write_text(text)
    with pytest.raises(InvalidParameter, match=r"device\.json"):
        read_device(path)


def test_the_scene_comes_out(taken: Taken) -> None:
    """Poses are where the scene put the tool, to some deviations."""
    poses = taken.table.poses
    good = poses.status == "OK"
    times = (taken.table.device_ns[poses.frame[good]]) * 1e-9
    _, origin = SCENE.pose(0, times)
    off = np.abs(poses.translation_mm[good] - origin)
    assert (off / poses.sd_mm[good] < 6.0).all()


def test_another_calibration(taken: Taken, tmp_path: Path) -> None:
    path = recording(tmp_path / "r.h5", taken, lines=False, results=True)
    with RecordingReader(path) as reader:
        found = table_from_recording(reader, (), ActiveCalibration("other", nominal(2.0)))
        assert found.notes == {"calibration": "other"}
        assert found.tools == ()
        same_as = table_from_recording(reader, ())
    assert not np.allclose(found.points.position_mm[0], same_as.points.position_mm[0])


def test_no_calibration(taken: Taken, tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with RecordingWriter(path, taken.description) as writer:
        for frame in taken.frames[:5]:
            writer.append(frame)
    with RecordingReader(path) as reader, pytest.raises(InvalidRecording, match="--calibration"):
        table_from_recording(reader)


def captured(taken: Taken, path: Path, *, bundled: bool = False) -> Path:
    wanted = frozenset({"points", "tracks", "tools"})
    messages = [
        message for batch in taken.batches for message in StreamBatch(batch).messages(wanted)
    ]
    lines = [json.dumps({"type": "hello", "device_id": "sim"})]
    if bundled:
        lines += [
            json.dumps(
                {"type": "frames", "device_id": "sim", "frames": messages[first : first + 7]}
            )
            for first in range(0, len(messages), 7)
        ]
    else:
        lines += [str(encode(message, "json")) for message in messages]
    path.write_text("\n".join([*lines, "", ""]))
    return path


@pytest.mark.parametrize("bundled", [False, True])
def test_a_captured_stream_gives_what_was_live(taken: Taken, tmp_path: Path, bundled: bool) -> None:
    found = table_from_stream(captured(taken, tmp_path / "s.jsonl", bundled=bundled))
    same(found, taken.table, ("rate_hz", "device"))
    assert found.rate_hz == pytest.approx(400.0, rel=1e-3)


def change(message: dict[str, Any], **changed: Any) -> str:
    return json.dumps(message | changed)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("{", "line 3"),
        ("[]", "line 3"),
        ("{}", "line 3"),
        ('{"type": "frame"}', "line 3"),
        ({"sequence": 0}, "in order"),
        ({"device_id": "other"}, "one device"),
        ({"sequence": "x"}, "line 3"),
        ({"tools": [{"tool_id": "probe"}]}, "line 3"),
        ({"points": [{"position_mm": [1, 2], "covariance_mm2": None}]}, "line 3"),
        ({"tracks": [{"id": 1, "marker": None, "state": "odd", "flags": []}]}, "line 3"),
    ],
)
def test_what_is_no_captured_stream(
    taken: Taken, tmp_path: Path, line: str | dict[str, Any], words: str
) -> None:
    path = captured(taken, tmp_path / "s.jsonl")
    kept = path.read_text().splitlines()[:2]
    first = json.loads(kept[1])
    text = line if isinstance(line, str) else change(first, **({"sequence": 5} | line))
    path.write_text("\n".join([*kept, text, ""]))
    with pytest.raises(InvalidParameter, match=words):
        table_from_stream(path)


@pytest.mark.parametrize("content", [b"", b"\n", b'{"type": "hello"}\n', b"\xff\xfe"])
def test_streams_without_frames(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.jsonl"
    path.write_bytes(content)
    with pytest.raises(InvalidParameter):
        table_from_stream(path)


@pytest.mark.slow
def test_command_line(taken: Taken, tmp_path: Path) -> None:
    source = recording(tmp_path / "r.h5", taken, lines=False, results=True)
    tools = tmp_path / "tools.json"
    tools.write_text(json.dumps([{"id": "probe", "markers_mm": MARKERS, "tip_mm": [0, -100, 0]}]))
    (nominal_json := tmp_path / "nominal.json").write_bytes(DOCUMENT.dump_json(nominal()))
    run = here("export", source, "--output", tmp_path / "a.igs.mha", "--tools", tools)
    assert f"{FRAMES} frames" in " ".join(run.stdout.split())
    _, frames = read_sequence(tmp_path / "a.igs.mha")
    assert frames[-1]["ProbeToTrackerTransformStatus"] == "OK"
    stream = captured(taken, tmp_path / "s.jsonl")
    here("export", stream, "--output", tmp_path / "b.trc", "--predicted")
    assert "probe_tip" in read_trc(tmp_path / "b.trc")[1]
    here("export", source, "--output", tmp_path / "c.csv", "--calibration", nominal_json)
    assert (tmp_path / "c.csv").read_text().count(",track,") > FRAMES


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--output", "a.xyz"), ".igs.mha"),
        (("--output", "r.h5"), ".igs.mha"),
        (("--output", "there.csv"), "exists"),
        (("--output", "a.igs.mha"), "--tools"),
        (("--output", "nowhere/a.csv"), "there is no folder nowhere"),
        (("--output", "a.csv", "--tools", "none.json"), "cannot be read"),
        (("--output", "a.csv", "--table", "t.h5"), "--calibration"),
    ],
)
def test_what_the_command_refuses(
    taken: Taken,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.csv").touch()
    short = replace_batches(taken, 2)
    recording(Path("r.h5"), short, lines=False, results=True)
    run = here("export", "r.h5", *arguments, code=2)
    assert words in " ".join(run.stderr.split())


def replace_batches(taken: Taken, count: int) -> Taken:
    short = Taken.__new__(Taken)
    short.__dict__.update(taken.__dict__ | {"batches": taken.batches[:count]})
    return short


def test_options_of_recordings_are_not_for_streams(taken: Taken, tmp_path: Path) -> None:
    (path := tmp_path / "nominal.json").write_bytes(nominal_document())
    stream = captured(taken, tmp_path / "s.jsonl")
    run = here("export", stream, "--output", tmp_path / "a.csv", "--calibration", path, code=2)
    assert "--calibration has no effect on a captured stream" in " ".join(run.stderr.split())


def test_a_rate_that_is_not_known_is_measured(taken: Taken) -> None:
    builder = TableBuilder("sim", 0.0, [])
    for batch in taken.batches:
        builder.add(batch)
    found = builder.build()
    assert found.rate_hz == pytest.approx(400.0, rel=1e-3)
    assert TableBuilder("sim", 0.0, []).build().rate_hz == 0.0
    assert len(replace(found, sequence=found.sequence[:0])) == 0
