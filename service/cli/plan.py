"""`lumiline plan`: predicts the accuracy of a device from its profile."""

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from compute.errors import LumilineError
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.planning.plan_result import Plan
from service.cli.output import console, fail, millimetres, print_json, progress


def run(
    profile: str | None, *, grid: int, markers: int | None, output: Path | None, as_json: bool
) -> None:
    """Work out and print a plan; draw it where a file is given. No profile: list them."""
    if profile is None:
        if output is not None:
            raise fail("--output wants a profile to draw the plan of")
        _list(as_json=as_json)
        return
    if output is not None and not output.parent.is_dir():
        raise fail(f"{output} cannot be written: there is no folder {output.parent}")
    from compute.planning.plan import plan

    try:
        device = load_profile(profile)
        with progress("planning", 1.0, quiet=as_json) as done:
            found = plan(device, grid=grid, markers=markers, progress=done)
    except LumilineError as error:
        raise fail(error.detail) from error
    if output is not None:
        from service.api.planning.plot import draw_plan

        try:
            output.write_bytes(draw_plan(found))
        except OSError as error:
            raise fail(f"{output} cannot be written: {error.strerror}") from error
    if as_json:
        print_json(found)
        return
    _print(found)
    if output is not None:
        console.print(f"written: {output}")


def _list(*, as_json: bool) -> None:
    profiles = [load_profile(name) for name in profile_names()]
    if as_json:
        print_json(
            [
                {
                    "name": one.name,
                    "title": one.title,
                    "year": one.year,
                    "sensors": len(one.sensors),
                }
                for one in profiles
            ]
        )
        return
    table = Table(title="device profiles: lumiline plan NAME, or FILE.toml", title_justify="left")
    table.add_column("name", no_wrap=True)
    for heading in ("year", "sensors"):
        table.add_column(heading, justify="right")
    table.add_column("device")
    for one in profiles:
        year = "" if one.year is None else str(one.year)
        table.add_row(one.name, year, str(len(one.sensors)), escape(one.title))
    console.print(table)


def _print(found: Plan) -> None:
    x, y, z = found.volume.size_mm
    centre = ", ".join(f"{value:g}" for value in found.volume.centre_mm)
    console.print(f"{found.profile}: {found.title}", style="bold", highlight=False)
    console.print(
        f"volume {x:g} x {y:g} x {z:g} mm about ({centre}) mm, "
        f"{' x '.join(map(str, found.grid))} points",
        highlight=False,
    )
    console.print(
        f"seen by all sensors: {_share(found.coverage.all_sensors)} of the volume, by three or "
        f"more: {_share(found.coverage.three_or_more)}",
        highlight=False,
    )
    for table in (_precision(found), _sensors(found), _rates(found)):
        console.print()
        console.print(table)
    if found.ghosts:
        console.print()
        console.print(_ghosts(found))
    for note in found.notes:
        console.print(f"- {note}", highlight=False)


def _precision(found: Plan) -> Table:
    table = Table(title="standard deviations and errors, mm", title_justify="left")
    table.add_column("")
    table.add_column("axis")
    for heading in ("centre", "best", "median", "worst"):
        table.add_column(heading, justify="right", no_wrap=True)
    for label, summary in (
        ("noise, bound", found.noise),
        ("noise, centre of gravity", found.centroid),
        ("for readings of 1 px", found.dilution),
        ("pixels' fixed pattern", found.fixed_pattern),
        ("distortion, uncorrected", found.distortion),
    ):
        columns = (summary.centre, summary.best, summary.median, summary.worst)
        for axis, name in enumerate("XYZ"):
            cells = [_length(values, axis) for values in columns]
            table.add_row(label if axis == 0 else "", name, *cells, end_section=axis == 2)
    return table


def _sensors(found: Plan) -> Table:
    table = Table(title="readings: medians over the volume", title_justify="left")
    table.add_column("sensor", no_wrap=True)
    for heading in (
        "sees", "line,\nke-", "pixel,\nke-", "full", "bound,\npx", "c.o.g.,\npx",
        "fixed,\npx", "dist.,\npx",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for sensor, share in zip(found.sensors, found.coverage.by_sensor, strict=True):
        table.add_row(
            sensor.name,
            _share(share),
            _thousands(sensor.scan_electrons),
            _thousands(sensor.peak_electrons),
            _share(sensor.saturated),
            _number(sensor.bound_px, digits=2),
            _number(sensor.centroid_px, digits=2),
            _number(sensor.fixed_pattern_px, digits=2),
            _number(sensor.misfit_px, digits=2),
        )
    return table


def _thousands(value: float | None) -> str:
    return _number(None if value is None else value / 1000.0, digits=3)


def _rates(found: Plan) -> Table:
    table = Table(title="rates, \\[3.1]-\\[3.3]", title_justify="left")
    table.add_column("")
    for one in found.rates:
        noun = "marker" if one.markers == 1 else "markers"
        table.add_column(f"{one.markers} {noun},\n{one.illumination}", justify="right")
    for label, values in (
        ("lines of a sensor, 1/s", [one.line_rate_hz for one in found.rates]),
        ("positions of a marker, 1/s", [one.marker_rate_hz for one in found.rates]),
        ("positions in all, 1/s", [one.points_per_s for one in found.rates]),
        ("pixels, 1e6/s", [one.raw_pixels_per_s / 1e6 for one in found.rates]),
        ("pixels, MB/s", [one.raw_bytes_per_s / 1e6 for one in found.rates]),
        ("readings instead, kB/s", [one.reduced_bytes_per_s / 1e3 for one in found.rates]),
    ):
        table.add_row(label, *(_number(value) for value in values))
    return table


def _ghosts(found: Plan) -> Table:
    table = Table(title="markers lit together: ghosts", title_justify="left")
    for heading in (
        "markers", "crossings in a\nplane \\[2.15]", "combinations", "expected\nghosts",
        "standard\nerror",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    for ghost, crossings in zip(found.ghosts, found.planar_intersections, strict=True):
        table.add_row(
            str(ghost.markers),
            str(crossings),
            str(ghost.candidates),
            _number(ghost.expected),
            _number(ghost.standard_error),
        )
    return table


def _length(values: tuple[float, ...] | None, axis: int) -> str:
    if values is None:
        return "-"
    # Less than a millionth of a millimetre is what rounding leaves of a symmetric device's zero.
    return "0" if values[axis] < 1e-6 else millimetres(values[axis])


def _share(value: float) -> str:
    return f"{100 * value:.3g} %"


def _number(value: float | None, digits: int = 3) -> str:
    if value is None:
        return "-"
    return f"{value:.{digits}g}" if value < 1e3 else f"{value:,.0f}"
