"""`lumiline simulate-serial` as a user runs it."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hardware.serial.driver import SerialDriver
from hardware.serial.settings import SerialSettings
from service.cli import app


@pytest.mark.slow
def test_a_pseudo_terminal_that_sends_parts(tmp_path: Path) -> None:
    link = tmp_path / "bar"
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "simulate-serial", "--pty", "--link", str(link),
         "--rate-hz", "100", "--cycle", "8", "--part", "512"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        told = re.search(r"the device is at (/dev/pts/\d+), also", process.stdout.readline())
        assert told is not None
        assert str(link.resolve()) == told[1]
        driver = SerialDriver("bar", SerialSettings(told[1]))
        driver.open()
        assert driver.description.frame_rate_hz == 100.0
        numbers = [frame.sequence for _, frame in zip(range(5), driver.frames(), strict=False)]
        assert numbers == [0, 1, 2, 3, 4]
        driver.close()
        process.send_signal(signal.SIGINT)
    assert process.returncode == 0
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "one of --listen HOST:PORT and --pty"),
        (["--pty", "--listen", "127.0.0.1:5000"], "one of --listen HOST:PORT and --pty"),
        (["--listen", "5000"], "must be HOST:PORT"),
        (["--listen", "127.0.0.1:70000"], "must be HOST:PORT"),
        (["--listen", "127.0.0.1:0", "--rate-hz", "0"], "--rate-hz"),
        (["--listen", "127.0.0.1:0", "--simulation", "{folder}/none.json"], "No such file"),
        (["--listen", "127.0.0.1:0", "--simulation", "{folder}/bad.json"], "colour"),
        (["--pty", "--link", "{folder}/bad.json"], "is no symbolic link"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, arguments: list[str], words: str) -> None:
    (tmp_path / "bad.json").write_text('{"colour": "red"}')
    given = [argument.format(folder=tmp_path) for argument in arguments]
    result = CliRunner().invoke(app, ["simulate-serial", *given])
    assert result.exit_code != 0
    assert words in " ".join(result.output.split())
