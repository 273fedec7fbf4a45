"""Output of commands: tables, JSON, progress, files, and errors that end a command."""

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from compute.calibration.result import AxisErrors


class WholeWordsConsole(Console):
    """A console that breaks lines between words only: an id or a path stays whole, to be copied.

    A table whose words do not fit into the terminal is wider than it.
    """

    def print(self, *objects: Any, **named: Any) -> None:
        """Print as Rich does."""
        widths = [
            self.measure(one, options=self.options.update(max_width=_UNLIMITED)).minimum
            for one in objects
            if isinstance(one, Table)
        ]
        if max(widths, default=0) > self.width:
            named.setdefault("width", max(widths))
        whole: dict[str, Any] = {"overflow": "ignore", "crop": False}
        super().print(*objects, **whole | named)


_UNLIMITED: Final = 10_000

console = WholeWordsConsole()
progress_console = WholeWordsConsole(stderr=True)
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
        yield lambda completed: bar.update(task, completed=completed)


def say(message: str) -> None:
    """Print a message without colouring its numbers."""
    console.print(message, highlight=False)


def say_written(path: Path) -> None:
    """Print that a file is written."""
    say(f"written: {escape(str(path))}")


def hint(message: str) -> None:
    """Print on standard error what a person is to do, where standard output holds JSON alone."""
    progress_console.print(message, highlight=False)


def print_json(value: Any) -> None:
    """Print a dataclass, a Pydantic model, or a list of them, as JSON on standard output."""
    typer.echo(json.dumps(value, indent=2, default=_plain))


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) else value.model_dump(mode="json")  # type: ignore[arg-type]


def fail(message: str) -> typer.Exit:
    """Print an error and return what ends the command: ``raise fail(...)``."""
    # What looks like markup in a message is none: [export], a path with brackets.
    # A console of its own: tests exchange standard error.
    WholeWordsConsole(stderr=True).print(f"[red]error:[/red] {escape(message)}", highlight=False)
    return typer.Exit(2)


@contextmanager
def file_errors(path: Path, doing: str = " cannot be written") -> Iterator[None]:
    """End the command where a file cannot be written, or read."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise fail(f"{error.filename or path}{doing}: {error.strerror or error}") from error


def check_folder(path: Path | None) -> None:
    """End the command before its work where a folder for its files could not be made."""
    if path is None or path.is_dir():
        return
    if path.exists():
        raise fail(f"{path} cannot be written into: it is a file; give a folder")
    check_output(path, force=False)


def check_output(path: Path | None, *, force: bool) -> None:
    """End the command before its work where a file could not be written, or would be lost.

    Args:
        path: the file; None: nothing is written.
        force: overwrite it where it exists.
    """
    if path is None or _is_special(path):
        return
    if path.is_dir():
        raise fail(f"{path} cannot be written: it is a folder")
    if not path.parent.is_dir():
        raise fail(f"{path} cannot be written: there is no folder {path.parent}")
    if not os.access(path.resolve().parent, os.W_OK):
        raise fail(f"{path} cannot be written: the folder {path.resolve().parent} is read-only")
    if path.exists() and not force:
        raise fail(f"{path} exists; choose another name, or overwrite it with --force")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield where to write a file, which takes its place only when it is whole.

    A failure leaves what was there before; an OSError ends the command with the reason.
    """
    if _is_special(path):
        with file_errors(path):
            yield path
        return
    target = path.resolve()
    with (
        file_errors(path),
        # Beside the file, as only that is sure to be on the same disk; formats state its name.
        tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder,
    ):
        temporary = Path(folder) / target.name
        yield temporary
        temporary.replace(target)


def _is_special(path: Path) -> bool:
    """Whether it is a pipe or a device, such as /dev/stdout."""
    return path.exists() and not path.is_file() and not path.is_dir()


def write_file(path: Path, content: bytes, *, quiet: bool = False) -> None:
    """Write a whole file and say so unless quiet, or end the command with the reason."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    if not quiet:
        say_written(path)


def make_table(
    headings: Iterable[str],
    rows: Iterable[Iterable[object]],
    title: str | None = None,
    *,
    texts: int | None = 1,
    no_wrap: bool = False,
) -> Table:
    """Return a table; None in a cell is a dash.

    Args:
        headings: of the columns.
        rows: cells, shown as ``str`` shows them.
        title: above the table.
        texts: number of columns of text, which come first; columns of numbers follow. None: all.
        no_wrap: keep numbers in one line.
    """
    table = Table(title=title, title_justify="left")
    cells = [["-" if cell is None else str(cell) for cell in row] for row in rows]
    for index, heading in enumerate(headings):
        if texts is None or index < texts:
            words = [Text.from_markup(row[index]).plain.split() or [""] for row in cells]
            table.add_column(
                heading,
                overflow="fold",
                # An id is one word, and stays whole.
                no_wrap=all(len(one) == 1 for one in words),
                min_width=max((len(word) for one in words for word in one), default=None),
            )
        else:
            table.add_column(heading, justify="right", no_wrap=no_wrap)
    for row in cells:
        table.add_row(*row)
    return table


def error_table(
    title: str,
    rows: Iterable[tuple[str, "AxisErrors | None", str]],
    readings: Sequence[int] | None = None,
) -> Table:
    """Return a table of mean and largest absolute errors by axis [mm].

    Args:
        title: the table's title.
        rows: label, errors, style; None for the errors prints dashes.
        readings: how many readings each row is over; None: no such column.
    """
    headings = ["", "mean X", "Y", "Z", "max X", "Y", "Z"]
    over = [] if readings is None else ["readings"]
    table = make_table([*headings, *over], (), title, no_wrap=True)
    for number, (label, errors, style) in enumerate(rows):
        cells = ["-"] * 6
        if errors is not None:
            cells = list(map(millimetres, (*errors.mean_absolute_mm, *errors.max_absolute_mm)))
        counts = [] if readings is None else [str(readings[number])]
        table.add_row(label, *cells, *counts, style=style)
    return table


def spec(value: object, form: str) -> str | None:
    """Return a number or a time in a format, None where there is none."""
    return None if value is None else format(value, form)


def millimetres(value: float) -> str:
    """Return a length in mm with three significant digits, or an exponent where it is tiny."""
    if value == 0.0:
        return "0"
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3g}"
