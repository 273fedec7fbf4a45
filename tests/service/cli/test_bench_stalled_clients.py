"""`lumiline bench stalled-clients`: a time that is too short for its rounds is refused."""

from typer.testing import CliRunner

from service.cli import app


def test_too_short_a_time_is_refused_before_anything_starts():
    result = CliRunner().invoke(app, ["bench", "stalled-clients", "--seconds", "15"])
    assert result.exit_code == 2
    assert "15 s are too short" in result.output
    assert "at least 20" in result.output
