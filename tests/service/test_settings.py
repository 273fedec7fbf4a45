"""Settings: defaults, environment, TOML file, and which of them wins."""

import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from service.settings import Settings


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LUMILINE_CONFIG", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.chdir(tmp_path)


def test_defaults(tmp_path: Path):
    settings = Settings()
    assert settings.data_dir == tmp_path / "share" / "lumiline"
    assert settings.effective_database_url == f"sqlite:///{settings.data_dir}/lumiline.sqlite3"
    assert settings.folders.recordings == settings.data_dir / "recordings"
    assert (settings.host, settings.port) == ("127.0.0.1", 8000)


@pytest.mark.parametrize("proxies", [("10.0.0.5",), ("10.0.0.0/24", "fd00::/8", "::1")])
def test_proxies_are_addresses_or_networks(proxies: tuple[str, ...]):
    assert Settings(trusted_proxies=proxies).trusted_proxies == proxies


@pytest.mark.parametrize(
    "wrong", ["*", "proxy.example", "10.0.0.1/8", "10.0.0.0/33", "0.0.0.0/0", "::/0", ""]
)
def test_no_others_are_believed(wrong: str):
    with pytest.raises(ValidationError, match="trusted_proxies"):
        Settings(trusted_proxies=("10.0.0.5", wrong))


def test_argument_before_environment_before_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "lumiline.toml").write_text('port = 1\nhost = "file"\nlog_level = "debug"\n')
    monkeypatch.setenv("LUMILINE_HOST", "environment")
    monkeypatch.setenv("LUMILINE_PORT", "2")
    settings = Settings(port=3)
    assert (settings.port, settings.host, settings.log_level) == (3, "environment", "debug")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"station": "none"}, "needs a bus_url"),
        ({"bus_url": "http://broker:4222"}, "nats://broker:4222"),
        ({"bus_url": "nats://one:4222,two"}, "nats://broker:4222"),
        ({"bus_ca": "ca.pem"}, "need a bus_url"),
        (
            {"bus_url": "nats://one", "bus_nkey_seed": "a", "bus_token_file": "b"},
            "one of bus_nkey_seed",
        ),
        ({"station_name": "Bar 1"}, "station_name"),
    ],
)
def test_settings_of_the_bus_go_together(wrong: dict[str, str], words: str):
    with pytest.raises(ValidationError, match=words):
        Settings(**wrong)


def test_bus_has_one_broker_or_several():
    assert Settings(bus_url="nats://a:secret@one:4222, tls://two", station="none").bus_url


def test_the_file_may_be_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "other.toml").write_text('database_url = "postgresql+psycopg://there/db"\n')
    monkeypatch.setenv("LUMILINE_CONFIG", str(tmp_path / "other.toml"))
    assert Settings().effective_database_url == "postgresql+psycopg://there/db"
    monkeypatch.setenv("LUMILINE_CONFIG", str(tmp_path / "none.toml"))
    with pytest.raises(FileNotFoundError, match=r"none\.toml"):
        Settings()


def test_variables_of_clients_are_left_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("LUMILINE_URL", "http://127.0.0.1:8000")
    monkeypatch.setenv("LUMILINE_KEY", "key")
    Settings()
    monkeypatch.setenv("LUMILINE_URI", "x")
    with pytest.raises(ValueError, match="LUMILINE_URI"):
        Settings()


@pytest.mark.parametrize("text", ["colour = 1", "port = 70000", 'log_level = "loud"'])
def test_what_does_not_fit_is_refused(tmp_path: Path, text: str):
    (tmp_path / "lumiline.toml").write_text(text)
    with pytest.raises(ValidationError, match=text.split(" ", maxsplit=1)[0]):
        Settings()


@pytest.mark.parametrize("text", ['database_ur1 = "x:s3cret@y"', 'database_url = ["x:s3cret@y"]'])
def test_the_error_does_not_hold_the_value(tmp_path: Path, text: str):
    (tmp_path / "lumiline.toml").write_text(text)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert "s3cret" not in str(caught.value)


def test_a_variable_that_is_no_setting_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("LUMILINE_AUTHENTIFICATION", "required")
    with pytest.raises(ValueError, match="did you mean LUMILINE_AUTHENTICATION") as caught:
        Settings()
    assert '"required"' not in str(caught.value)
    monkeypatch.delenv("LUMILINE_AUTHENTIFICATION")
    monkeypatch.setenv("LUMILINE_QQQ", "1")
    with pytest.raises(ValueError, match="LUMILINE_QQQ, which is no setting"):
        Settings()
    monkeypatch.delenv("LUMILINE_QQQ")
    monkeypatch.setenv("LUMILINE_TEST_ANYTHING", "1")
    monkeypatch.setenv("lumiline_port", "81")
    assert Settings().port == 81


def test_process_of_the_station_is_refused_where_there_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert Settings().station == "thread"
    with pytest.raises(ValidationError, match="needs Linux"):
        Settings(station="process")
