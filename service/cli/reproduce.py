"""`lumiline reproduce`: published tests, the reference figures and ours side by side."""

from pathlib import Path

from rich.markup import escape
from rich.progress import track
from rich.table import Table

from service.cli.output import console, error_table, fail, print_json, progress_console
from validation.all_cases import ALL_CASES
from validation.cases import CaseResult
from validation.tables import Cell, ResultTable, TablesCase, TablesResult

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
    results = [
        case.run()
        for case in track(
            chosen, "reproducing", console=progress_console, transient=True, disable=as_json
        )
    ]
    if as_json:
        print_json(results if name == "all" else results[0])
        return
    for result in results:
        if isinstance(result, TablesResult):
            _print_tables(result)
        else:
            _print(result)


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
        console.print()
        console.print(_table(table))
    for finding in result.findings:
        console.print(f"- {escape(finding)}")


def _table(table: ResultTable) -> Table:
    # A unit in brackets is no markup.
    shown = Table(title=escape(table.title), title_justify="left")
    for heading, *cells in zip(table.headings, *table.rows, strict=True):
        numbers = any(isinstance(cell, float | int) for cell in cells)
        shown.add_column(escape(heading), justify="right" if numbers else "left")
    for row in table.rows:
        shown.add_row(*(_cell(cell) for cell in row))
    return shown


def _cell(cell: Cell) -> str:
    if cell is None:
        return "-"
    return escape(cell) if isinstance(cell, str) else f"{cell:.4g}"
