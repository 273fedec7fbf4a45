"""`lumiline peaks`: each kind of file, tables, JSON, pictures, and what is refused."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from compute.errors import InvalidParameter
from compute.optics.profiles.profile_loader import load_profile
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.settings import SimulationSettings
from service.api.line_scans.methods import CentroidMethod, FitMethod
from service.api.line_scans.noise import line_noise
from service.api.line_scans.peak_search import find_peaks
from service.cli import app
from service.cli.peaks import recorded_method
from service.pipeline.detection_stage import (
    FREE_WIDTH_FIT,
    DetectionStage,
    ExpectedScans,
    expected_scans,
)
from tests.service.api.line_scans.scan_lines import NOISE, WIDTH, scenes

GIVEN = ("--gain", "10", "--read-noise", "20", "--offset", "100", "--full-scale", "4095")


def run(*arguments: str | Path | float, code: int = 0) -> Any:
    result = CliRunner().invoke(app, ["peaks", *map(str, arguments)], env={"COLUMNS": "80"})
    assert result.exit_code == code, result.output
    return result


def refusal(*arguments: str | Path | float) -> str:
    return " ".join(run(*arguments, code=2).output.split())


def machine(*arguments: str | Path | float) -> Any:
    return json.loads(run(*arguments, "--json").stdout)


def positions(found: Any) -> list[list[float]]:
    return [[peak["position_px"] for peak in scan["peaks"]] for scan in found["scans"]]


@pytest.fixture
def array(tmp_path: Path) -> Path:
    np.save(tmp_path / "lines.npy", scenes())
    return tmp_path / "lines.npy"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("recording") / "sim.h5"
    driver = SimulatedDriver("sim", SimulationSettings(realtime=False, duration_s=0.05))
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            writer.append(frame)
    return path


def test_a_numpy_array_s_peaks_are_compute_s(array: Path) -> None:
    found = machine(array, "--line-sigma-px", WIDTH, *GIVEN)
    batch = fit_scans(scenes(), FitSettings(width_px=WIDTH), line_noise(NOISE))
    for line, ours in enumerate(positions(found)):
        assert ours == batch.position_px[line, : batch.count[line]].tolist()
    assert found["assumed"] == []
    assert [scan["index"] for scan in found["scans"]] == [0, 1]
    one = machine(array, "--scan", 1, "--line-sigma-px", WIDTH, *GIVEN)
    assert one["scans"] == found["scans"][1:]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("header", [True, False])
def test_csv_says_the_same(array: Path, tmp_path: Path, delimiter: str, header: bool) -> None:
    path = tmp_path / "lines.csv"
    names = delimiter.join(f"pixel {k}" for k in range(512)) if header else ""
    np.savetxt(path, scenes(), fmt="%d", delimiter=delimiter, header=names, comments="")
    if not header:
        path.write_text("\ufeff" + path.read_text("utf-8"), "utf-8")
    assert machine(path, *GIVEN) == machine(array, *GIVEN)


def test_a_recording_knows_its_noise(recording: Path) -> None:
    found = machine(recording, "--exposure", 7)
    assert found["noise"] == {
        "electrons_per_count": 12.0,
        "read_noise_electrons": 30.0,
        "offset_counts": 64.0,
        "full_scale_counts": 4095,
    }
    assert found["assumed"] == []
    assert [len(scan["peaks"]) for scan in found["scans"]] == [1, 1, 1, 1]
    one = machine(recording, "--exposure", 7, "--sensor", "diagonal-rising")
    assert one["scans"] == found["scans"][2:3]
    assert machine(recording, "--exposure", 8)["scans"] != found["scans"]
    assert [scan["sensor"] for scan in found["scans"]][2] == "diagonal-rising"
    part = machine(recording, "--exposure", 7, "--offset", 60)["noise"]
    assert part == found["noise"] | {"offset_counts": 60.0}
    given = machine(recording, "--exposure", 7, *GIVEN)
    assert given["noise"]["electrons_per_count"] == 10.0


def test_a_recording_of_a_profile_has_one_peak_for_a_marker(tmp_path: Path) -> None:
    path = tmp_path / "bar.h5"
    # Two frames are traced sooner than the whole volume is.
    settings = ProfileSettings(realtime=False, duration_s=0.02, optics="exact")
    driver = ProfileDriver("bar", load_profile("bar"), settings)
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in islice(driver.frames(), 2):
            writer.append(frame)
    for method in ([], ["--method", "fit"]):
        found = machine(path, *method)
        assert [len(scan["peaks"]) for scan in found["scans"]] == [1, 1, 1, 1]
    split = machine(path, "--further-peaks")
    assert sum(scan["further_peaks"] for scan in split["scans"]) > 0
    assert "--no-further-peaks" in run(path, "--further-peaks").output
    assert "--no-further-peaks" not in run(path).output


def test_recorded_lines_are_fitted_as_they_are_live(recording: Path) -> None:
    with RecordingReader(recording) as reader:
        device, frames = reader.info.description, [reader.chunk(0)[0].lines]
    live = DetectionStage(device, 1, ExpectedScans()).find(np.concatenate(frames))
    for line, places in enumerate(positions(machine(recording))):
        count = int(live.count[line])
        # The kernel's numbers are of float32.
        assert places == pytest.approx(live.position_px[line, :count].tolist(), abs=1e-3)
    assert recorded_method(None, replace(device, peaks="centroid")) == CentroidMethod()
    free = recorded_method(None, replace(device, line_sigma_px=None))
    assert isinstance(free, FitMethod)
    assert (free.max_joint_peaks, free.further_peaks) == (
        FREE_WIDTH_FIT.max_joint_peaks,
        FREE_WIDTH_FIT.further_peaks,
    )
    assert machine(recording, "--method", "matched")["method"] == "matched"


@pytest.fixture(scope="module")
def shadows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a device behind coded windows."""
    path: Path = tmp_path_factory.mktemp("shadows") / "coda.h5"
    settings = ProfileSettings(realtime=False, duration_s=0.02)
    driver = ProfileDriver("coda", load_profile("coda-mpx30"), settings)
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in islice(driver.frames(), 2):
            writer.append(frame)
    return path


@pytest.mark.slow
def test_recorded_shadows_are_read_as_they_are_live(shadows: Path) -> None:
    with RecordingReader(shadows) as reader:
        device, frame = reader.info.description, reader.chunk(1)[0]
    live = DetectionStage(device, 1, expected_scans(device)).find(frame.lines)
    assert live.count.tolist() == [1, 1, 1]
    found = machine(shadows, "--exposure", 1)
    assert found["method"] == "mask"
    assert positions(found) == [[place] for place in live.position_px[:, 0]]
    # One sensor's line is read with that sensor's shadow.
    for one in (["--sensor", device.sensors[2].name], ["--scan", 2]):
        assert machine(shadows, "--exposure", 1, *one)["scans"] == found["scans"][2:]
    output = shadows.with_name("shadow.png")
    assert "1 peak" in run(shadows, "--output", output).output
    assert output.read_bytes().startswith(b"\x89PNG")
    assert machine(shadows, "--method", "centroid")["method"] == "centroid"


def test_lines_without_a_shadow_that_is_known(array: Path, recording: Path, shadows: Path) -> None:
    assert "--settings" in refusal(array, "--method", "mask")
    assert "has no coded windows" in refusal(recording, "--method", "mask")
    with RecordingReader(shadows) as reader:
        device = reader.info.description
    with pytest.raises(InvalidParameter, match="names no profile"):
        recorded_method(None, replace(device, profile=None))
    with pytest.raises(InvalidParameter, match="Gray tracks"):
        recorded_method(None, replace(device, readout="gray-tracks"))
    assert recorded_method("centroid", replace(device, readout="gray-tracks")) == CentroidMethod()


def test_tables(array: Path, recording: Path) -> None:
    text = run(array, "--line-sigma-px", WIDTH).output
    for part in ("line 0: 3 peaks", "joint", "saturated", "guessed: gain", "full scale"):
        assert part in text
    method = FitMethod(width_px=WIDTH)
    for scan in find_peaks(scenes(), method).scans:
        assert all(f"{peak.position_px:.4f}" in text for peak in scan.peaks)
    assert "guessed" not in run(array, *GIVEN).output
    assert "diagonal-falling, exposure 0: 1 peak" in run(recording).output
    text = run(array, "--method", "matched", "--line-sigma-px", WIDTH).output
    assert "the response must exceed" in " ".join(text.split())
    flat = array.with_name("flat.npy")
    np.save(flat, np.full(100, 200))
    assert "line 0: no peaks" in run(flat).output
    np.save(flat, np.full(100, 4095))
    assert "100 pixels saturated" in " ".join(run(flat).output.split())
    assert "saturated" not in run(recording).output


def test_an_offset_alone_mends_the_guess(array: Path) -> None:
    blind, told = machine(array), machine(array, "--offset", 100)
    assert told["noise"]["electrons_per_count"] < blind["noise"]["electrons_per_count"]
    assert "lower limits" in " ".join(run(array).output.split())
    full = machine(array, "--full-scale", 8191)
    assert full["noise"] == blind["noise"] | {"full_scale_counts": 8191}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["centroid", "fit", "chain", "matched"])
def test_a_picture_of_each_method(array: Path, method: str) -> None:
    pictures = []
    lines = (0, 1) if method == "centroid" else (1,)  # that a line is chosen is said once
    for line in lines:
        output = array.with_name(f"{line}.png")
        shown = run(array, "--scan", line, "--method", method, "--output", output)
        assert "written" in shown.output
        pictures.append(output.read_bytes())
    assert all(one.startswith(b"\x89PNG") and len(one) > 10_000 for one in pictures)
    assert len(set(pictures)) == len(lines)


def test_settings_as_rest_takes_them(array: Path) -> None:
    file = array.with_name("method.json")
    file.write_text('{"method": "fit", "width_px": 1.2, "max_joint_peaks": 1}', "utf-8")
    found = machine(array, "--settings", file, *GIVEN, "--detail")
    method = FitMethod(width_px=1.2, max_joint_peaks=1)
    ours = find_peaks(scenes(), method, NOISE, detail=True)
    assert found == json.loads(ours.model_dump_json())


def test_the_documents_chain_takes_the_pair_apart() -> None:
    examples = Path(__file__).parents[3] / "docs" / "examples"
    found = machine(examples / "lines.csv", "--settings", examples / "chain.json", *GIVEN)
    (places,) = positions(found)
    assert places == pytest.approx([31.3, 78.2, 81.9], abs=0.3)


def test_floating_counts_are_taken_when_whole(array: Path) -> None:
    other = array.with_name("float.npy")
    np.save(other, scenes().astype(np.float64))
    assert machine(other) == machine(array)


def test_what_is_refused(array: Path, recording: Path, tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "none.csv").lower()
    assert "0 to 1" in refusal(array, "--scan", 2)
    assert "--exposure is for recordings" in refusal(array, "--exposure", 0)
    assert "--sensor is for recordings" in refusal(array, "--sensor", "a")
    assert "0 to 49" in refusal(recording, "--exposure", 50)
    assert "vertical, horizontal" in refusal(recording, "--sensor", "none")
    assert "centroid, fit, chain, matched" in refusal(array, "--method", "best")
    assert "--line-sigma-px is for" in refusal(array, "--method", "chain", "--line-sigma-px", 2)
    assert "less than or equal to 16" in refusal(array, "--line-sigma-px", 20)
    assert "--gain and --read-noise" in refusal(array, "--gain", 3)
    assert "above full_scale_counts, 1023" in refusal(array, *GIVEN[:-1], 1023)
    assert "end in .png" in refusal(array, "--output", tmp_path / "x.pdf")
    assert "--detail has no effect without --json" in refusal(array, "--detail")
    assert "--further-peaks is for" in refusal(array, "--method", "chain", "--further-peaks")
    assert "less than or equal to 65535" in refusal(array, "--offset", 1e9)
    assert "no folder" in refusal(array, "--output", tmp_path / "no" / "x.png")
    assert "none.json" in refusal(array, "--settings", tmp_path / "none.json").replace(" ", "")
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"method": "fit", "colour": 1}', "utf-8")
    assert "colour" in refusal(array, "--settings", wrong)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no line of counts"),
        ("a,b,c\n", "no line of counts"),
        (",".join(["1"] * 63), "63 pixels"),
        (",".join(["1"] * 64) + "\n" + ",".join(["1"] * 65), "line 1 has 65 values"),
        (",".join(["1"] * 64) + "\n" + ",".join(["1"] * 63 + ["x"]), 'line 1, pixel 63 is "x"'),
        (",".join(["1"] * 63 + ["1.5"]), 'line 0, pixel 63 is "1.5"'),
        (",".join(["1"] * 63 + ["65536"]), 'pixel 63 is "65536"'),
        (",".join(["1"] * 63 + ["nan"]), 'pixel 63 is "nan"'),
    ],
)
def test_a_wrong_csv_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "wrong.csv"
    path.write_text(text, "utf-8")
    assert words in refusal(path)


@pytest.mark.parametrize(
    "values", [np.full((2, 2, 64), 1), np.full(64, -1), np.full(64, 0.5), np.full(64, np.nan),
               np.full(64, 70000), np.full(64, "1"), np.empty((0, 64))],
)  # fmt: skip
def test_a_wrong_array_is_refused(tmp_path: Path, values: Any) -> None:
    path = tmp_path / "wrong.npy"
    np.save(path, values)
    assert "it must be" in refusal(path)
    path.write_bytes(path.read_bytes()[:40])
    assert "cannot be read" in refusal(path)
