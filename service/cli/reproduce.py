"""`lumiline reproduce`: published tests, with the published and our figures side by side."""

from collections.abc import Callable, Iterator
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from service.cli.output import console, error_table, fail, print_json, progress
from validation.all_cases import ALL_CASES
from validation.progress import Listener, progress_listener
from validation.result_tables import Cell, ResultTable, TablesCase, TablesResult
from validation.tests_5_1_to_5_8 import CaseResult

SETTLED_PX = 0.01


def run(name: str | None, *, as_json: bool, output: Path | None = None) -> None:
    """List the cases, or run one of them, or ``all``; draw the one's picture to ``output``."""
    if output is not None:
        _draw(name, output)
    if name is None:
        _list(as_json=as_json)
        return
    if name != "all" and name not in ALL_CASES:
        raise fail(f'there is no case "{name}"; the cases are {", ".join(ALL_CASES)} and all')
    chosen = list(ALL_CASES.values()) if name == "all" else [ALL_CASES[name]]
    results = []
    with progress("reproducing", float(len(chosen)), quiet=as_json) as done:
        for place, case in enumerate(chosen):
            with progress_listener(_from(place, done)):
                results.append(case.run())
            done(place + 1.0)
    if as_json:
        print_json(results if name == "all" else results[0])
        return
    for result in results:
        if isinstance(result, TablesResult):
            _print_tables(result)
        else:
            _print(result)


def _from(place: int, done: Callable[[float], None]) -> Listener:
    return lambda share, _stage: done(place + share)


def _draw(name: str | None, output: Path) -> None:
    """Draw a case's picture, or say which cases have one."""
    case = ALL_CASES.get(name) if name is not None else None
    if not isinstance(case, TablesCase) or case.picture is None:
        drawn = [
            other.name
            for other in ALL_CASES.values()
            if isinstance(other, TablesCase) and other.picture is not None
        ]
        raise fail(f"--output wants a case that has a picture: {', '.join(drawn)}")
    if not output.parent.is_dir():
        raise fail(f"there is no folder {output.parent} to write {output.name} to")
    case.picture(output)


def _list(*, as_json: bool) -> None:
    rows = [{"name": c.name, "title": c.title, "source": c.source} for c in ALL_CASES.values()]
    if as_json:
        print_json(rows)
        return
    table = Table(title="cases: lumiline reproduce NAME, or all", title_justify="left")
    table.add_column("name", no_wrap=True)
    for heading in ("title", "source"):
        table.add_column(heading)
    for row in rows:
        table.add_row(*row.values())
    console.print(table)


def _print(result: CaseResult) -> None:
    console.print()
    console.print(
        error_table(
            f"{result.name}: {result.title}\n{result.source}; absolute errors in mm",
            [
                *((column.label, column.errors, "dim") for column in result.published),
                *((column.label, column.errors, "") for column in result.ours),
            ],
        )
    )
    points = Table(title="principal points, mm from the sensor's edge", title_justify="left")
    points.add_column("")
    for sensor in range(4):
        points.add_column(f"sensor {sensor + 1}", justify="right")
    for column in (*result.published, *result.ours):
        if column.principal_points_mm is not None:
            points.add_row(column.label, *(f"{v:.3f}" for v in column.principal_points_mm))
    console.print(points)
    for column in result.ours:
        if column.reason is not None:
            console.print(f"{column.label}: {column.reason}")
        if column.iteration_change_px is not None and column.iteration_change_px > SETTLED_PX:
            console.print(
                f"{column.label}: not settled, a corrected reading still changes by "
                f"{column.iteration_change_px:.2g} px in the last of 30 iterations"
            )
    console.print(result.note, style="italic")


def _print_tables(result: TablesResult) -> None:
    console.print()
    console.print(f"{result.name}: {result.title}", style="bold")
    console.print(result.source, style="italic")
    for table in result.tables:
        for part in _fitting(table, console.width):
            console.print()
            console.print(part)
    for finding in result.findings:
        console.print(f"- {escape(finding)}")


def _fitting(table: ResultTable, width: int) -> Iterator[Table]:
    """Yield a table as it is, or, where its numbers do not fit, in parts with the same labels."""
    columns = list(zip(table.headings, *table.rows, strict=True))
    numeric = [any(isinstance(cell, float | int) for cell in cells) for _, *cells in columns]
    # The columns of text before the first number, or the first number itself, name the rows.
    labels = max(1, numeric.index(True) if True in numeric else len(columns))
    needed = [
        max(len(word) for word in (*str(heading).split(), *map(_cell, cells))) + 3
        for heading, *cells in columns
    ]
    head = list(range(labels))
    part: list[int] = []
    for index in range(labels, len(columns)):
        if part and 1 + sum(needed[k] for k in (*head, *part, index)) > width:
            yield _table(table, columns, [*head, *part], numeric, needed)
            part = []
        part.append(index)
    if part or labels == len(columns):
        yield _table(table, columns, [*head, *part], numeric, needed)


def _table(
    table: ResultTable,
    columns: list[tuple[Cell, ...]],
    shown: list[int],
    numeric: list[bool],
    needed: list[int],
) -> Table:
    # A unit in brackets is no markup.
    part = Table(title=escape(table.title), title_justify="left")
    for index in shown:
        part.add_column(
            escape(str(columns[index][0])),
            justify="right" if numeric[index] else "left",
            min_width=needed[index] - 3 if numeric[index] else None,
            overflow="fold",
        )
    for row in table.rows:
        part.add_row(*(escape(_cell(row[index])) for index in shown))
    return part


def _cell(cell: Cell) -> str:
    if cell is None:
        return "-"
    return cell if isinstance(cell, str) else f"{cell:.4g}"
