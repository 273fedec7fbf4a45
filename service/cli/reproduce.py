"""`lumiline reproduce`: published tests, with the published and our figures side by side."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from service.cli.options import AsJson, Force, refuse_unused
from service.cli.output import (
    atomic_file,
    check_output,
    console,
    error_table,
    fail,
    make_table,
    print_json,
    progress,
)
from validation.all_cases import ALL_CASES
from validation.progress import Listener, progress_listener
from validation.result_tables import Cell, ResultTable, TablesCase, TablesResult
from validation.tests_5_1_to_5_8 import Case, CaseResult

SETTLED_PX = 0.01


def _complete_case(incomplete: str) -> list[str]:
    """Return the cases whose names begin so, for the shell's completion."""
    return [name for name in (*ALL_CASES, "all") if name.startswith(incomplete)]


def reproduce(
    context: typer.Context,
    case: Annotated[
        str | None, typer.Argument(help="A case's name, or all.", autocompletion=_complete_case)
    ] = None,
    as_json: AsJson = False,
    output: Annotated[Path | None, typer.Option(help="Draw the case's picture: a PNG.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of a case that draws random numbers.")
    ] = None,
    trials: Annotated[
        int | None, typer.Option(min=1, help="Number of random trials of a case that has them.")
    ] = None,
    force: Force = False,
) -> None:
    """List the cases, or run one of them, or all; draw the picture of one where it is wanted."""
    if case is None:
        refuse_unused(context, "without a case", "output", "seed", "trials", "force")
        _list(as_json=as_json)
        return
    if case != "all" and case not in ALL_CASES:
        raise fail(f'there is no case "{case}"; the cases are {", ".join(ALL_CASES)} and all')
    chosen = list(ALL_CASES.values()) if case == "all" else [ALL_CASES[case]]
    options = {
        name: value for name, value in (("seed", seed), ("trials", trials)) if value is not None
    }
    if len(chosen) == 1:
        for name in options:
            if name not in _options(chosen[0]):
                takers = [one.name for one in ALL_CASES.values() if name in _options(one)]
                raise fail(f"{case} has no --{name}; the cases that have one: {', '.join(takers)}")
    if output is None:
        refuse_unused(context, "without --output", "force")
    else:
        _draw(case, output, force=force)
    results: list[CaseResult | TablesResult] = []
    with progress("reproducing", float(len(chosen)), quiet=as_json) as report:
        for index, one in enumerate(chosen):
            with progress_listener(_from(index, report)):
                if isinstance(one, TablesCase):
                    case_options = {name: options[name] for name in one.options if name in options}
                    results.append(one.run(**case_options))
                else:
                    results.append(one.run())
            report(index + 1.0)
    if as_json:
        print_json(results if case == "all" else results[0])
        return
    for result in results:
        if isinstance(result, TablesResult):
            _print_tables(result)
        else:
            _print(result)


def _options(case: Case | TablesCase) -> tuple[str, ...]:
    return case.options if isinstance(case, TablesCase) else ()


def _from(index: int, report: Callable[[float], None]) -> Listener:
    return lambda share, _stage: report(index + share)


def _draw(name: str, output: Path, *, force: bool) -> None:
    """Draw a case's picture, or say which cases have one."""
    case = ALL_CASES.get(name)
    if not isinstance(case, TablesCase) or case.picture is None:
        drawn = [
            other.name
            for other in ALL_CASES.values()
            if isinstance(other, TablesCase) and other.picture is not None
        ]
        raise fail(f"--output wants a case that has a picture: {', '.join(drawn)}")
    check_output(output, force=force)
    with atomic_file(output) as temporary:
        case.picture(temporary)


def _list(*, as_json: bool) -> None:
    rows = [
        {
            "name": case.name,
            "title": case.title,
            "source": case.source,
            "options": " ".join(f"--{option}" for option in _options(case)),
        }
        for case in ALL_CASES.values()
    ]
    if as_json:
        print_json(rows)
        return
    title = "cases: lumiline reproduce NAME, or all"
    table = make_table(
        ("name", "title", "source", "options"), (row.values() for row in rows), title, texts=None
    )
    table.columns[0].no_wrap = True
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
    rows = (
        [column.label, *(f"{value:.3f}" for value in column.principal_points_mm)]
        for column in (*result.published, *result.ours)
        if column.principal_points_mm is not None
    )
    headings = ["", *(f"sensor {number}" for number in range(1, 5))]
    console.print(make_table(headings, rows, "principal points, mm from the sensor's edge"))
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
    indices: list[int],
    numeric: list[bool],
    needed: list[int],
) -> Table:
    # A unit in brackets is no markup.
    part = Table(title=escape(table.title), title_justify="left")
    for index in indices:
        part.add_column(
            escape(str(columns[index][0])),
            justify="right" if numeric[index] else "left",
            min_width=needed[index] - 3 if numeric[index] else None,
            overflow="fold",
        )
    for row in table.rows:
        part.add_row(*(escape(_cell(row[index])) for index in indices))
    return part


def _cell(cell: Cell) -> str:
    if cell is None:
        return "-"
    return cell if isinstance(cell, str) else f"{cell:.4g}"
