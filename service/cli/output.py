"""Output of commands: tables on the terminal, JSON for programs."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from compute.calibration.result import AxisErrors

console = Console()
progress_console = Console(stderr=True)
"""Progress goes to standard error, so that standard output holds the result only."""


@contextmanager
def progress(
    text: str, total: float | None = None, *, quiet: bool = False
) -> Iterator[Callable[[float], None]]:
    """Show on standard error what goes on; yields a function that takes the amount done.

    Args:
        text: what is done.
        total: the whole amount; None: not known.
        quiet: show nothing.
    """
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
        console=progress_console, transient=True, disable=quiet,
    )  # fmt: skip
    with bar:
        task = bar.add_task(text, total=total)
        yield lambda done: bar.update(task, completed=done)


def print_json(value: Any) -> None:
    """Print a dataclass, or a list of them, as JSON on standard output."""
    typer.echo(json.dumps(_plain(value), indent=2))


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def fail(message: str) -> typer.Exit:
    """Print an error and return what ends the command: ``raise fail(...)``."""
    # What looks like markup in a message is none: [export], a path with brackets.
    Console(stderr=True).print(f"[red]error:[/red] {escape(message)}", highlight=False)
    return typer.Exit(2)


def error_table(
    title: str,
    rows: Iterable[tuple[str, AxisErrors | None, str]],
    readings: Sequence[int] | None = None,
) -> Table:
    """Return a table of mean and largest absolute errors by axis [mm].

    Args:
        title: the table's title.
        rows: label, errors, style; None for the errors prints dashes.
        readings: how many readings each row is over; None: no such column.
    """
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for heading in ("mean X", "Y", "Z", "max X", "Y", "Z"):
        table.add_column(heading, justify="right", no_wrap=True)
    if readings is not None:
        table.add_column("readings", justify="right", no_wrap=True)
    for number, (label, errors, style) in enumerate(rows):
        over = [] if readings is None else [str(readings[number])]
        if errors is None:
            table.add_row(label, *["-"] * 6, *over, style=style)
            continue
        values = (*errors.mean_absolute_mm, *errors.max_absolute_mm)
        table.add_row(label, *(millimetres(value) for value in values), *over, style=style)
    return table


def millimetres(value: float) -> str:
    """Return a length in mm with three significant digits, or an exponent where it is tiny."""
    if value == 0.0:
        return "0"
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3g}"
