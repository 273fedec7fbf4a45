"""`lumiline plan`: predicts the accuracy of a device from its profile."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from compute.optics.profiles.profile_loader import (
    load_profile,
    profile_names,
    with_error_sources,
)
from compute.planning.plan_result import AccuracyBudget, AxisSummary, Plan
from service.cli.options import AsJson, Force, complete_profile, refuse_unused
from service.cli.output import (
    atomic_file,
    check_output,
    console,
    make_table,
    millimetres,
    print_json,
    progress,
    say,
    say_written,
)


def plan(
    context: typer.Context,
    profile: Annotated[
        str | None,
        typer.Argument(
            help="A device profile's name, or its TOML file.", autocompletion=complete_profile
        ),
    ] = None,
    grid: Annotated[
        int, typer.Option(min=3, max=21, help="Points of the volume along each axis.")
    ] = 5,
    markers: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Most markers to count ghosts for."),
    ] = None,
    assume: Annotated[
        list[str] | None,
        typer.Option(
            help="A source of error, as in a profile's error_sources: 'temperature_change=5 K'. "
            "Repeat it for others."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Draw the plan: a PNG to write.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Work out and print a plan; draw it where a file is given. No profile: list them."""
    if profile is None:
        names = ("grid", "markers", "assume", "output", "force")
        refuse_unused(context, "without a profile to plan with", *names)
        _list(as_json=as_json)
        return
    check_output(output, force=force)
    if output is None:
        refuse_unused(context, "without --output", "force")
    from compute.planning import plan as planning

    device = with_error_sources(load_profile(profile), assume or ())
    with progress("planning", 1.0, quiet=as_json) as report:
        result = planning.plan(device, grid=grid, markers=markers, progress=report)
    if output is not None:
        from service.api.planning.plot import draw_plan

        with atomic_file(output) as temporary:
            temporary.write_bytes(draw_plan(result))
    if as_json:
        print_json(result)
        return
    _print(result)
    if output is not None:
        say_written(output)


def _list(*, as_json: bool) -> None:
    profiles = [load_profile(name) for name in profile_names()]
    if as_json:
        rows = [(one.name, one.title, one.year, len(one.sensors)) for one in profiles]
        names = ("name", "title", "year", "sensors")
        print_json([dict(zip(names, row, strict=True)) for row in rows])
        return
    cells = ((one.name, one.year or "", len(one.sensors), escape(one.title)) for one in profiles)
    title = "device profiles: lumiline plan NAME, or FILE.toml"
    console.print(make_table(("name", "year", "sensors", "device"), cells, title, texts=None))


def _print(plan: Plan) -> None:
    x, y, z = plan.volume.size_mm
    centre = ", ".join(f"{value:g}" for value in plan.volume.centre_mm)
    console.print(f"{plan.profile_id}: {plan.title}", style="bold", highlight=False)
    say(
        f"volume {x:g} x {y:g} x {z:g} mm about ({centre}) mm, "
        f"{' x '.join(map(str, plan.grid))} points"
    )
    say(
        f"seen by all sensors: {_share(plan.coverage.all_sensors)} of the volume, by three or "
        f"more: {_share(plan.coverage.three_or_more)}"
    )
    budget = () if plan.budget is None else (_budget(plan.budget), _inputs(plan.budget))
    tables = [_precision(plan), *budget, _sensors(plan), _rates(plan)]
    for table in [*tables, _ghosts(plan)] if plan.ghosts else tables:
        console.print()
        console.print(table)
    for note in plan.notes:
        say(f"- {note}")


def _precision(plan: Plan) -> Table:
    headings = ("", "axis", "centre", "best", "median", "worst")
    title = "standard deviations and errors, mm"
    table = make_table(headings, (), title, texts=2, no_wrap=True)
    for label, summary in (
        ("noise, bound", plan.noise),
        ("noise, centre of gravity", plan.centroid),
        ("for readings of 1 px", plan.dilution),
        ("pixels' fixed pattern", plan.fixed_pattern),
        ("distortion, uncorrected", plan.distortion),
    ):
        columns = (summary.centre, summary.best, summary.median, summary.worst)
        for axis, name in enumerate("XYZ"):
            cells = [_length(values, axis) for values in columns]
            table.add_row(label if axis == 0 else "", name, *cells, end_section=axis == 2)
    return table


def _budget(budget: AccuracyBudget) -> Table:
    headings = ("*: assumed", "X,\ncentre", "Y,\ncentre", "Z,\ncentre", "3D RMS,\nvolume", "share")
    title = f"accuracy budget, standard uncertainties, mm: {budget.dominant} dominates"
    table = make_table(headings, (), title, no_wrap=True)
    for one in budget.contributions:
        name = f"{one.name}{' *' if one.assumed else ''}"
        share = _share(one.share) if one.counted else "not in it"
        table.add_row(name, *_centre(one.sigma), millimetres(one.rms_mm), share)
    table.add_section()
    table.add_row("random", *_centre(budget.random), "", "")
    table.add_row("systematic", *_centre(budget.systematic), "", "")
    table.add_row("total", *_centre(budget.total), millimetres(budget.total_rms_mm), "100 %")
    return table


def _centre(summary: AxisSummary) -> list[str]:
    return [_length(summary.centre, axis) for axis in range(3)]


def _inputs(budget: AccuracyBudget) -> Table:
    rows = (
        (
            one.name,
            " ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in _values(one.value))
            + f" {one.unit}",
            ("assumed: " if one.assumed else "") + one.source,
        )
        for one in budget.inputs
    )
    title = "what the budget rests on: error_sources of the profile, or --assume NAME=VALUE"
    return make_table(("", "value", "source"), rows, title, texts=None)


def _values(value: float | str | tuple[float, ...]) -> tuple[float | str, ...]:
    return value if isinstance(value, tuple) else (value,)


def _sensors(plan: Plan) -> Table:
    headings = (
        "sensor", "sees", "line,\nke-", "pixel,\nke-", "full", "bound,\npx", "c.o.g.,\npx",
        "fixed,\npx", "dist.,\npx",
    )  # fmt: skip
    rows = (
        (sensor.name, _share(share), _thousands(sensor.scan_electrons),
         _thousands(sensor.peak_electrons), _share(sensor.saturated),
         _number(sensor.bound_px, digits=2), _number(sensor.centroid_px, digits=2),
         _number(sensor.fixed_pattern_px, digits=2), _number(sensor.misfit_px, digits=2))
        for sensor, share in zip(plan.sensors, plan.coverage.by_sensor, strict=True)
    )  # fmt: skip
    table = make_table(headings, rows, "readings: medians over the volume")
    table.columns[0].no_wrap = True
    return table


def _thousands(value: float | None) -> str | None:
    return _number(None if value is None else value / 1000.0, digits=3)


def _rates(plan: Plan) -> Table:
    rates = plan.rates
    headings = [
        f"{one.markers} marker{'' if one.markers == 1 else 's'},\n{one.illumination}"
        for one in rates
    ]
    rows = (
        ("lines of a sensor, 1/s", [one.line_rate_hz for one in rates]),
        ("positions of a marker, 1/s", [one.marker_rate_hz for one in rates]),
        ("positions in all, 1/s", [one.points_per_s for one in rates]),
        ("pixels, 1e6/s", [one.raw_pixels_per_s / 1e6 for one in rates]),
        ("pixels, MB/s", [one.raw_bytes_per_s / 1e6 for one in rates]),
        ("readings instead, kB/s", [one.reduced_bytes_per_s / 1e3 for one in rates]),
    )
    cells = ([label, *map(_number, values)] for label, values in rows)
    return make_table(["", *headings], cells, "rates, \\[3.1]-\\[3.3]")


def _ghosts(plan: Plan) -> Table:
    headings = (
        "markers", "crossings in a\nplane \\[2.15]", "combinations", "expected\nghosts",
        "standard\nerror",
    )  # fmt: skip
    rows = (
        (ghost.markers, crossings, ghost.candidates, _number(ghost.expected),
         _number(ghost.standard_error))
        for ghost, crossings in zip(plan.ghosts, plan.planar_intersections, strict=True)
    )  # fmt: skip
    return make_table(headings, rows, "markers lit together: ghosts", texts=0)


def _length(values: tuple[float, ...] | None, axis: int) -> str:
    if values is None:
        return "-"
    # Less than a millionth of a millimetre is what rounding leaves of a symmetric device's zero.
    return "0" if values[axis] < 1e-6 else millimetres(values[axis])


def _share(value: float) -> str:
    return "< 0.1 %" if 0.0 < value < 1e-3 else f"{100 * value:.3g} %"


def _number(value: float | None, digits: int = 3) -> str | None:
    if value is None:
        return None
    return f"{value:.{digits}g}" if value < 1e3 else f"{value:,.0f}"
