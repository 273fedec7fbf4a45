"""Options that several commands have: each has one name, one meaning and one unit in all of them.

Lengths are in mm; an option in another unit ends in it, as `--line-sigma-px`.
tests/service/cli/test_all_commands.py holds these rules for every command.
"""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.output import fail


def complete_profile(incomplete: str) -> list[str]:
    """Return the built-in device profiles whose names begin so, for the shell's completion."""
    from compute.optics.profiles.profile_loader import profile_names

    return [name for name in profile_names() if name.startswith(incomplete)]


AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]

CalibrationOption = Annotated[
    Path | None,
    typer.Option(help="Calibration as JSON, from `calibrate`; left out: the recorded ones."),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        help="A device profile: optotrak, ..., or a TOML file.", autocompletion=complete_profile
    ),
]
TableOption = Annotated[
    Path | None, typer.Option(help="Correction table (HDF5) of that calibration.")
]
SimulationOption = Annotated[
    Path | None, typer.Option(help="Simulation settings as JSON, as in a device's source.")
]
PositionSigma = Annotated[
    float,
    typer.Option(min=0.0, help=r"Standard deviation of the known positions \[mm]; 0: exact."),
]
StrobeMarkers = Annotated[
    str | None, typer.Option(help="The strobed markers, in this order, such as 0,1,2,3.")
]
RateHz = Annotated[float | None, typer.Option(min=0.001, help="Exposures per second.")]
ComputeDevice = Annotated[str | None, typer.Option(help="Where to compute: cpu, cuda:0, ...")]
TemperatureC = Annotated[float | None, typer.Option(help=r"Of the sensors \[°C].")]

HERE = "http://127.0.0.1:8000"
Url = Annotated[str, typer.Option(envvar="LUMILINE_URL", help="The server.", show_default=True)]
Key = Annotated[
    str | None,
    typer.Option(envvar="LUMILINE_KEY", help="API key; better in the variable than here."),
]
DeviceOption = Annotated[str | None, typer.Option(help="Only those of this device.")]
WatchSeconds = Annotated[
    float | None, typer.Option(min=0.1, help="How long; left out: until Ctrl-C.")
]


def refuse_unused(context: typer.Context, why: str, *names: str) -> None:
    """End the command where one of these options is on the command line, as it has no effect.

    What an environment variable gives is for all commands, and is not refused.

    Args:
        context: of the command.
        why: it has none, after "has no effect ".
        names: the options' parameters.
    """
    options = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise fail(f"{options[name]} has no effect {why}; leave it out")


def numbers(text: str, option: str, example: str) -> list[int]:
    """Return the whole numbers that an option lists, or end the command."""
    try:
        return [int(one) for one in text.replace(",", " ").split()]
    except ValueError:
        raise fail(f'{option} is "{text}"; it must be whole numbers, such as {example}') from None
