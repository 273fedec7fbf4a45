"""`lumiline tools` beside a server."""

import pytest
from rich.console import Console
from typer.testing import CliRunner

from lumiline.client.models import Pose
from service.cli import app
from service.cli.tools import _poses


@pytest.mark.slow
def test_a_device_that_is_not_there(server: str) -> None:
    result = CliRunner().invoke(app, ["tools", "watch", "--url", server, "--device", "nix"])
    assert result.exit_code == 2
    assert "no device" in result.output
    assert '"nix"' in result.output
    result = CliRunner().invoke(app, ["tools", "watch", "--url", server, "--device", "sim"])
    assert "there are no tools" in result.output


def test_reasons_have_the_whole_width(capsys: pytest.CaptureFixture[str]) -> None:
    reason = "no exposure could have shown it [yet]: three of its markers are needed"
    values = dict.fromkeys(Pose.model_fields)
    known = {
        "tool_id": "pointer",
        "device_id": "sim",
        "frame_id": "tracker",
        "status": "HIGH_ERROR",
    }
    place = {"tip_mm": (-1234.5, -2345.6, -3456.7), "age_s": 0.25, "reason": reason}
    Console(width=80).print(_poses([Pose.model_construct(**(values | known | place))]))
    assert f"pointer: {reason}" in [line.rstrip() for line in capsys.readouterr().out.splitlines()]
