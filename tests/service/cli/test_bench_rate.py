"""`lumiline bench rate`: rates are tried until one is lossy; the highest that holds is said."""

import json
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from service.cli import app, bench_rate


def figures_of_rates(monkeypatch, tmp_path, rates_hz, kept_hz, kept_all_the_time_hz):
    """What is found where short trials up to a rate are kept, and long ones up to another."""

    def trial(_folder, _service, _client, rate_hz, seconds):
        limit_hz = kept_hz if seconds == bench_rate.TRIAL_S else kept_all_the_time_hz
        return {"rate_hz": rate_hz, "seconds": seconds, "kept": rate_hz <= limit_hz}

    monkeypatch.setattr(bench_rate, "RATES_HZ", rates_hz)
    monkeypatch.setattr(bench_rate, "_trial", trial)
    service = nullcontext(SimpleNamespace(url="http://127.0.0.1"))
    monkeypatch.setattr(bench_rate, "service_process", lambda *_, **__: service)
    monkeypatch.setattr(bench_rate, "client_session", lambda *_: nullcontext())
    return bench_rate._measure(tmp_path, 60.0, quiet=True)


@pytest.mark.parametrize(
    ("kept_all_the_time_hz", "tried_hz", "highest_hz"),
    [(3.0, [3.0], 3.0), (2.0, [3.0, 2.0], 2.0), (0.0, [3.0, 2.0, 1.0], None)],
)
def test_the_highest_rate_is_the_one_that_is_kept_all_the_time(
    monkeypatch, tmp_path, kept_all_the_time_hz, tried_hz, highest_hz
):
    rates_hz = (1.0, 2.0, 3.0, 4.0, 5.0)
    figures = figures_of_rates(monkeypatch, tmp_path, rates_hz, 3.0, kept_all_the_time_hz)
    assert [trial["rate_hz"] for trial in figures["trials"]] == [1.0, 2.0, 3.0, 4.0]
    assert [trial["rate_hz"] for trial in figures["whole_time"]] == tried_hz
    assert figures["highest_rate_hz"] == highest_hz


@pytest.mark.slow
def test_a_slow_device_is_kept_by_service_and_relay(monkeypatch):
    monkeypatch.setattr(bench_rate, "RATES_HZ", (50.0,))
    monkeypatch.setattr(bench_rate, "TRIAL_S", 1.0)
    result = CliRunner().invoke(app, ["bench", "rate", "--seconds", "2", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["highest_rate_hz"] == 50.0
    assert 0.0 < figures["whole_time"][0]["relay_hz"] < 51.0
