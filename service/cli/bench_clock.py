"""`lumiline bench clock`: simulated accuracy of clock synchronisation with a device."""

from typing import Any

from service.cli.output import console, make_table, print_json


def run(*, as_json: bool, **_: Any) -> None:
    """Simulate all cases and print."""
    from hardware.clock_sync_simulation import CASES, SETTLED_S, errors

    results = [errors(case) for case in CASES]
    if as_json:
        print_json(results)
        return
    rows = (
        (one.name, f"{one.hull_us:.1f}", f"{one.stated_us:.1f}", f"{one.regression_us:.1f}",
         f"{one.arrival_us:.1f}")
        for one in results
    )  # fmt: skip
    headings = ("case", "lowest line", "its sigma", "regression", "arrival")
    title = f"RMS error of exposures' host times after {SETTLED_S:g} s, us"
    console.print(make_table(headings, rows, title))
    console.print("beyond the line's shortest delay, which nobody on the host can see")
