"""Rules of the command line, held for every command, also for those that come later."""

import json
import re
import socket
import sys
from collections import defaultdict
from collections.abc import Iterator
from inspect import getsource, unwrap
from pathlib import Path
from typing import Any, Final, get_type_hints

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from service.cli import LazyCommand, app

NO_RESULT: Final = {
    "serve": "runs until it is ended",
    "station": "runs until it is ended",
    "openapi": "its document is JSON",
}
"""Commands that print no result, or nothing but JSON."""
AT_ONCE: Final = {
    "beam-holds acknowledge": "one request",
    "beam-holds list": "two requests a hold",
    "beam-holds show": "two requests",
    "beam-holds watch": "prints as changes come",
    "bench": "the benchmarks show their own",
    "blink-codes": "0.3 s",
    "cameras": "the library answers within a second",
    "examples": "0.3 s",
    "keys create": "one row",
    "keys list": "one query",
    "keys revoke": "one row",
    "openapi": "prints nothing but the document",
    "radiometric-calibration activate": "one request",
    "radiometric-calibration deactivate": "one request",
    "radiometric-calibration list": "one request",
    "radiometric-calibration upload": "one request",
    "serve": "has a log",
    "station": "has a log",
    "simulate-serial": "prints its address and serves",
    "tools create": "a request a tool, each with a line",
    "tools list": "one request",
    "tools show": "two requests",
    "tools watch": "shows what it sees",
}
"""Commands without a progress bar, and why they need none."""
OTHER_NAMES: Final = {
    "--to": "--output", "--out": "--output", "--file": "--output", "--start": "--calibration",
    "--sigma": "--position-sigma", "--control-sigma": "--position-sigma",
    "--point-sigma": "--position-sigma", "--overwrite": "--force", "--yes": "--force",
    "--live": "--device", "--server": "--url", "--width": "--line-sigma-px",
    "--duration": "--seconds", "--rate": "--rate-hz", "--random-seed": "--seed",
}  # fmt: skip
"""Names under which an option would come a second time."""
UNITS: Final = {"um": "-um", "px": "-px", "s": "-s", "°C": "-c", "Hz": "-hz", "mm": ""}
SAMPLES: Final = {
    "key": "abc", "scope": "read:stream", "name": "n", "hold": "h", "tool": "t", "device": "d",
    "radiometric_id": "r", "positions": "0 300", "markers": "4",
}  # fmt: skip
"""Values of what a command must be given, where that is no file."""
SUBJECTS: Final = {"reproduce": ["section-6.1"], "plan": ["bar"], "wand": ["no-readings.csv"]}
"""Arguments that may be left out, without which an output has no effect."""


def _all() -> Iterator[tuple[str, Any]]:
    def walk(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        whole = command.load() if isinstance(command, LazyCommand) else command
        if not hasattr(whole, "commands"):
            yield " ".join(words), whole
        for name, one in sorted(getattr(whole, "commands", {}).items()):
            yield from walk(one, (*words, name))

    yield from walk(get_command(app), ())


COMMANDS: Final = dict(_all())


def _options(command: Any) -> list[Any]:
    return [one for one in command.params if one.opts[0].startswith("--") and one.name != "help"]


def _outputs(command: Any) -> list[Any]:
    """Parameters that name a file or folder to write."""
    return [
        one
        for one in command.params
        if re.search(r"\bto write\b|^Write |^Draw |^Folder ", one.help or "")
    ]


def _kinds(command: Any) -> dict[str, str]:
    """Type of each parameter, whether it may be left out or not."""
    hints = get_type_hints(unwrap(command.callback))
    return {
        name: getattr(hint, "__name__", str(hint)).removesuffix(" | None").removeprefix("pathlib.")
        for name, hint in hints.items()
    }


def _arguments(command: Any, folder: Path) -> list[str]:
    """What the command must be given; the files are not there."""
    words: list[str] = []
    for one in command.params:
        if one.required:
            value = SAMPLES.get(one.name, str(folder / f"no-{one.name}.h5"))
            words += [one.opts[0], value] if one.opts[0].startswith("--") else [value]
    words += SUBJECTS.get(command.name, ())
    return words


def _run(name: str, *words: str) -> Any:
    return CliRunner().invoke(app, [*name.split(), *words], env={"COLUMNS": "60"})


def test_options_same_name_has_same_type_everywhere() -> None:
    kinds: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for name, command in COMMANDS.items():
        types = _kinds(command)
        for option in _options(command):
            kinds[option.opts[0]][types[option.name]].append(name)
    differ = {option: dict(by_kind) for option, by_kind in kinds.items() if len(by_kind) > 1}
    assert not differ


def test_options_one_thing_has_one_name() -> None:
    found = [
        f"{name} {option.opts[0]}: call it {OTHER_NAMES[option.opts[0]]}"
        for name, command in COMMANDS.items()
        for option in _options(command)
        if option.opts[0] in OTHER_NAMES
    ]
    assert not found


def test_options_name_ends_in_unit_other_than_mm() -> None:
    wrong = []
    for name, command in COMMANDS.items():
        for option in _options(command):
            unit = re.search(r"\[(um|px|s|°C|Hz|mm)\]", (option.help or "").replace("\\", ""))
            if unit and not option.opts[0].endswith(UNITS[unit[1]]):
                wrong.append(f"{name} {option.opts[0]} is in {unit[1]}")
    assert not wrong


@pytest.mark.parametrize("name", COMMANDS)
def test_command_that_prints_a_result_has_json(name: str) -> None:
    has = "--json" in {option.opts[0] for option in _options(COMMANDS[name])}
    assert has != (name in NO_RESULT)


@pytest.mark.parametrize("name", COMMANDS)
def test_command_shows_progress_or_is_quick(name: str) -> None:
    source = getsource(sys.modules[unwrap(COMMANDS[name].callback).__module__])
    assert "progress(" in source or name in AT_ONCE


WRITERS: Final = [
    (name, one.name) for name, command in COMMANDS.items() for one in _outputs(command)
]


def test_writers_are_found() -> None:
    names = {name for name, _ in WRITERS}
    assert {"calibrate", "wand", "map", "export", "record", "backup", "demo", "examples"} <= names
    forced = {
        name for name, command in COMMANDS.items()
        if "--force" in {option.opts[0] for option in _options(command)}
    }  # fmt: skip
    assert forced == names


def _with_output(name: str, parameter: str, output: Path, folder: Path) -> list[str]:
    command = COMMANDS[name]
    option = next(one for one in command.params if one.name == parameter)
    words = _arguments(command, folder)
    if option.opts[0].startswith("--"):
        words += [option.opts[0], str(output)]
    else:
        missing = str(folder / f"no-{parameter}.h5")
        words[words.index(missing)] = str(output)
    if parameter == "report_figures":
        words += ["--report", str(folder / "report.html")]
    return words


SUFFIX: Final = {"export": ".csv", "peaks": ".png"}


@pytest.mark.parametrize(("name", "parameter"), WRITERS)
def test_output_is_checked_before_work(
    name: str, parameter: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An existing file is kept, and a folder that is not there is told, before inputs are read."""
    monkeypatch.setenv("LUMILINE_DATA_DIR", str(tmp_path / "data"))
    output = tmp_path / f"out{SUFFIX.get(name, '.x')}"
    output.write_text("mine", encoding="utf-8")
    run = _run(name, *_with_output(name, parameter, output, tmp_path))
    assert run.exit_code == 2, run.output
    assert re.search("--force|give a folder|Not a directory", run.stderr), run.stderr
    assert str(output) in run.stderr
    nowhere = tmp_path / "nowhere" / output.name
    run = _run(name, *_with_output(name, parameter, nowhere, tmp_path))
    assert run.exit_code == 2
    assert f"there is no folder {nowhere.parent}" in " ".join(run.stderr.split())
    assert [one.name for one in tmp_path.iterdir()] == [output.name]
    assert output.read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("name", "parameter"),
    [one for one in WRITERS if one[0] not in ("record", "backup", "demo", "examples", "plan")
     and one[0] != "reproduce"],
)  # fmt: skip
def test_failure_leaves_no_file(name: str, parameter: str, tmp_path: Path) -> None:
    """The inputs are not there: whatever else is written would be empty."""
    output = tmp_path / f"out{SUFFIX.get(name, '.x')}"
    run = _run(name, *_with_output(name, parameter, output, tmp_path))
    assert run.exit_code == 2, (run.output, run.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", [name for name, command in COMMANDS.items() if "key" in {o.name for o in command.params}
             and "url" in {o.name for o in command.params} and name != "wand"],
)  # fmt: skip
def test_client_command_names_the_address_that_did_not_answer(name: str, tmp_path: Path) -> None:
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{taken.getsockname()[1]}"
        words = _arguments(COMMANDS[name], tmp_path)
        file = tmp_path / "no-file.h5"
        if str(file) in words:
            tool = {"id": "t", "device_id": "d", "markers_mm": [[0, 0, 0]], "sensors": {}}
            file.write_text(json.dumps(tool), encoding="utf-8")
        if name == "tools capture":
            words += ["--markers", "4"]
        run = _run(name, *words, "--url", url)
    assert run.exit_code == 2, (run.output, run.exception)
    assert url in run.stderr
    assert "Traceback" not in run.stderr


NO_EFFECT: Final = [
    ("backup x --keep 3", "--keep"),
    ("backup x --files --force", "--force"),
    ("bench --seconds 5", "--seconds"),
    ("bench signal --seconds 5", "--seconds"),
    ("bench live --rate-hz 9", "--rate-hz"),
    ("bench pose --compute-device cpu", "--compute-device"),
    ("calibrate a.csv --pixels 640 --force", "--force"),
    ("calibrate a.csv --sensors a=640 --pixels 640", "--pixels"),
    ("calibrate a.csv --sensors a=640 --pitch-um 5", "--pitch-um"),
    ("calibrate a.csv --pixels 640 --report-figures x", "--report-figures"),
    ("drift a.csv --calibration c.json --update-sensors A", "--update-sensors"),
    ("drift a.csv --calibration c.json --force", "--force"),
    ("drift a.csv --calibration c.json --earlier b.csv --position-sigma 1", "--position-sigma"),
    ("export a.h5 --output a.csv --predicted", "--predicted"),
    ("export a.h5 --output a.parquet --points", "--points"),
    ("export a.h5 --output a.c3d --points --predicted", "--predicted"),
    ("export a.jsonl --output a.csv --tools t.json", "--tools"),
    ("export a.jsonl --output a.csv --device-file t.json", "--device-file"),
    ("peaks a.csv --detail", "--detail"),
    ("peaks a.csv --force", "--force"),
    ("peaks a.csv --settings s.json --method fit", "--method"),
    ("peaks a.csv --settings s.json --line-sigma-px 2", "--line-sigma-px"),
    ("plan --grid 3", "--grid"),
    ("plan --output a.png", "--output"),
    ("plan bar --force", "--force"),
    ("readings a.h5 --output a.csv --still-px 1", "--still-px"),
    ("replay a.h5 --batch 3", "--batch"),
    ("replay a.h5 --json", "--json"),
    ("replay a.h5 --force", "--force"),
    ("replay a.h5 --check --output x", "--output"),
    ("replay a.h5 --check --calibration x", "--calibration"),
    ("reproduce --seed 1", "--seed"),
    ("reproduce --output a.png", "--output"),
    ("reproduce test-5.4 --force", "--force"),
    ("simulate-serial --listen 127.0.0.1:0 --link x", "--link"),
    ("wand a.csv --positions 0,1 --url http://x", "--url"),
    ("wand a.csv --positions 0,1 --seconds 5", "--seconds"),
    ("wand a.csv --positions 0,1 --strobe-markers 0,1", "--strobe-markers"),
    ("wand a.csv --positions 0,1 --from-readings", "--from-readings"),
    ("wand --recording a.h5 --positions 0,1 --pixels 640", "--pixels"),
    ("wand --recording a.h5 --positions 0,1 --sensors a=640", "--sensors"),
    ("wand a.csv --positions 0,1 --sensors a=640 --pixels 640", "--pixels"),
    ("wand a.csv --positions 0,1 --calibration c.json --sensors a=640", "--sensors"),
    ("wand a.csv --positions 0,1 --calibration c.json --pixels 640", "--pixels"),
    ("wand a.csv --positions 0,1 --pixels 640 --force", "--force"),
]


@pytest.mark.parametrize(("line", "option"), NO_EFFECT)
def test_option_without_effect_is_refused(line: str, option: str) -> None:
    run = _run(*line.split())
    assert run.exit_code == 2, (run.output, run.exception)
    assert f"{option} has no effect" in " ".join(run.stderr.split())


def test_environment_is_no_option_without_effect(tmp_path: Path) -> None:
    """LUMILINE_URL is for all commands, also for those that need no server."""
    missing = tmp_path / "no.csv"
    run = CliRunner().invoke(
        app,
        ["wand", str(missing), "--positions", "0 300"],
        env={"LUMILINE_URL": "http://127.0.0.1:1"},
    )
    assert "cannot be read" in " ".join(run.stderr.split())


def test_completion_of_commands_options_and_values() -> None:
    def complete(line: str) -> str:
        words = line.split(" ")
        environment = {
            "_LUMILINE_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(len(words) - 1),
        }
        result = CliRunner().invoke(app, [], prog_name="lumiline", env=environment)
        return result.output

    assert {"readings", "record", "replay", "restore"} < set(complete("lumiline re").split())
    assert "--output" in complete("lumiline export --ou").split()
    assert "acknowledge" in complete("lumiline beam-holds a").split()
    assert "test-5.4" in complete("lumiline reproduce test-5").split()
    assert "optotrak" in complete("lumiline record x.h5 --profile opto").split()
    assert "hostile-bodies" in complete("lumiline bench ho").split()
    assert "read:audit" in complete("lumiline keys create x --scope read").split()
    assert "--install-completion" in CliRunner().invoke(app, ["--help"]).output
