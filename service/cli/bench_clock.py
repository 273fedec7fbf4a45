"""`lumiline bench clock`: simulated accuracy of clock synchronisation with a device."""

from dataclasses import asdict

from rich.table import Table

from service.cli.output import console, print_json


def run(*, as_json: bool) -> None:
    """Simulate all cases and print."""
    from hardware.clock_sync_simulation import CASES, SETTLED_S, errors

    found = [errors(case) for case in CASES]
    if as_json:
        print_json([asdict(one) for one in found])
        return
    title = f"RMS error of exposures' host times after {SETTLED_S:g} s, us"
    table = Table(title=title, title_justify="left")
    table.add_column("case")
    for column in ("lowest line", "it says", "regression", "arrival"):
        table.add_column(column, justify="right")
    for one in found:
        values = (one.hull_us, one.stated_us, one.regression_us, one.arrival_us)
        table.add_row(one.name, *(f"{value:.1f}" for value in values))
    console.print(table)
    console.print("beyond the line's shortest delay, which nobody on the host can see")
