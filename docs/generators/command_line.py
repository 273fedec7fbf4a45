"""Reference page of the command line: the help text of every command."""

from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

from generators.text import page as whole_page
from service.cli import LazyCommand, app


def page() -> str:
    """Return the page."""
    lines = _command(get_command(app), [])
    return whole_page("Command line", "`lumiline --help`", lines)


def _command(command: Any, words: list[str]) -> list[str]:
    lines = [f"{'#' * (len(words) + 1)} lumiline {' '.join(words)}", ""] if words else []
    lines += ["```text", _help(words), "```", ""]
    commands = getattr(command, "commands", {})
    for name in sorted(commands):
        one = commands[name]
        lines += _command(one.load() if isinstance(one, LazyCommand) else one, [*words, name])
    return lines


def _help(words: list[str]) -> str:
    """Return a command's help as plain text, 100 characters wide."""
    result = CliRunner().invoke(
        app,
        [*words, "--help"],
        prog_name="lumiline",
        env={"TERMINAL_WIDTH": "100", "NO_COLOR": "1", "COLUMNS": "100"},
    )
    if result.exit_code != 0:
        raise RuntimeError(f"lumiline {' '.join(words)} --help failed: {result.output}")
    return "\n".join(line.rstrip() for line in result.output.strip().splitlines())
