"""The example in docs/how-to/recordings.md reads a live recording to its end."""

import os
import re
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from hardware.recording.writer import RecordingWriter
from tests.hardware.recording.blocks import block, described

DOCUMENT = Path(__file__).parents[3] / "docs" / "how-to" / "recordings.md"


def followed(capsys: pytest.CaptureFixture[str]) -> str:
    """Run the example; return what it prints."""
    (example,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    thread = Thread(target=exec, args=(example, names), daemon=True)
    thread.start()
    thread.join(240.0)
    assert not thread.is_alive(), "it never ends"
    assert names["ended"]
    return capsys.readouterr().out


@pytest.mark.parametrize("complete", [True, False], ids=["closed", "of a writer that died"])
def test_it_ends(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    complete: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "first.h5"
    with RecordingWriter(path, described()) as writer:
        writer.append_block(block(0, 70))
        writer.close(complete=complete)
    if not complete:
        os.utime(path, (0, path.stat().st_mtime - 60.0))
    assert followed(capsys) == "frames 0 to 70\n"


def test_it_goes_on_with_a_writer_that_lives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with RecordingWriter(tmp_path / "first.h5", described()) as writer:
        writer.append_block(block(0, 70))
        writer.flush()

        def sleep(_: float) -> None:
            writer.append_block(block(70, 30))
            writer.close()

        monkeypatch.setattr("time.sleep", sleep)
        assert followed(capsys) == "frames 0 to 70\nframes 70 to 100\n"
