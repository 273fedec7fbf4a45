"""`lumiline radiometric-calibration`: offset, response and bad pixels of sensors."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from lumiline.client.models import RadiometricCalibrationSummary, RadiometricCapture
from service.cli.json_files import read_json
from service.cli.options import HERE, AsJson, DeviceOption, Force, Key, TemperatureC, Url
from service.cli.output import (
    atomic_file,
    check_output,
    console,
    fail,
    hint,
    make_table,
    print_json,
    progress,
    say,
    say_written,
    spec,
)
from service.cli.server_session import client_session

radiometric_calibration = typer.Typer(
    help="Radiometric calibrations of sensors: offset, response, noise and bad pixels.",
    no_args_is_help=True,
    add_completion=False,
)

RadiometricId = Annotated[str, typer.Argument(help="The radiometric calibration's id.")]
Light = Annotated[
    list[float] | None,
    typer.Option(help="Light of each flat level in any unit, in their order: for the linearity."),
]
NewId = Annotated[str | None, typer.Option("--id", help="Left out: the server's choice.")]


@radiometric_calibration.command("estimate")
def estimate(
    dark: Annotated[Path, typer.Option(help="Recording of the covered sensors.")],
    flat: Annotated[
        list[Path], typer.Option(help="Recording under even light; one for each level of light.")
    ],
    output: Annotated[Path, typer.Option(help="JSON file to write; `upload` takes it.")],
    light: Light = None,
    temperature_c: TemperatureC = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Estimate the calibration of each sensor from recordings, without a server."""
    from service.api.radiometric_calibrations.content import sensor_figures
    from service.api.radiometric_calibrations.recorded_frames import estimate_from_recordings

    check_output(output, force=force)
    with progress("estimating", quiet=as_json):
        device, estimates = estimate_from_recordings(
            dark, flat, relative_light=light, temperature_c=temperature_c
        )
    sensors = {name: one.to_document() for name, one in estimates.items()}
    content = {"device": device.name, "sensors": sensors}
    with atomic_file(output) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    figures = [sensor_figures(name, one).model_dump() for name, one in estimates.items()]
    if as_json:
        print_json(figures)
    else:
        console.print(_figures(figures, str(dark)))
        say_written(output)


@radiometric_calibration.command("line-shape")
def line_shape(
    recording: Annotated[
        Path, typer.Argument(help="Recording of one marker, moved over all pixels.")
    ],
    output: Annotated[Path, typer.Option(help="JSON file to write; `upload` takes it.")],
    estimate_file: Annotated[
        Path | None, typer.Option(help="JSON file of `estimate`; left out: pixels are alike.")
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Measure the shape of the lines of each sensor by position (coma), without a server."""
    from service.api.radiometric_calibrations.content import content_of, sensor_figures
    from service.api.radiometric_calibrations.recorded_lines import with_line_shapes

    check_output(output, force=force)
    pixel_content = {} if estimate_file is None else content_of(read_json(estimate_file)).sensors
    with progress("measuring the lines", quiet=as_json):
        device, content = with_line_shapes(recording, pixel_content)
    sensors = {name: one.to_document() for name, one in content.items()}
    with atomic_file(output) as temporary:
        text = json.dumps({"device": device.name, "sensors": sensors}, allow_nan=False)
        temporary.write_text(text, encoding="utf-8")
    if as_json:
        print_json([sensor_figures(name, one).model_dump() for name, one in content.items()])
        return
    rows = (
        (
            name, one.line_shape.lines, f"{one.line_shape.width_px:.3f}",
            f"{one.line_shape.skewness[0]:+.3f}", f"{one.line_shape.skewness[-1]:+.3f}",
            f"{one.line_shape.reduced_chi2:.3f}",
        )
        for name, one in content.items()
        if one.line_shape is not None
    )  # fmt: skip
    headings = ("sensor", "lines", "width, px", "skewness,\nfirst", "skewness,\nlast", "chi2 / dof")
    console.print(make_table(headings, rows, str(recording)))
    say_written(output)


@radiometric_calibration.command("list")
def show_all(
    device: DeviceOption = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """List the radiometric calibrations of a server."""
    with client_session(url, key) as client:
        listed = client.radiometric_calibrations(device_id=device)
    if as_json:
        print_json(listed)
        return
    rows = (
        (
            one.id,
            one.device_id,
            "yes" if one.active else "no",
            one.origin,
            len(one.sensors),
            one.note,
        )
        for one in listed
    )
    console.print(make_table(("id", "device", "active", "from", "sensors", "note"), rows, texts=6))


@radiometric_calibration.command("capture")
def capture(
    device: Annotated[str, typer.Argument(help="A running device.")],
    frames: Annotated[int, typer.Option(min=16, max=4096, help="Of each capture.")] = 128,
    levels: Annotated[int, typer.Option(min=2, max=32, help="Levels of light.")] = 6,
    temperature_c: TemperatureC = None,
    radiometric_id: NewId = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Capture dark and flat frames step by step, and estimate the calibration from them."""
    with client_session(url, key, timeout_s=60.0) as client:
        session = client.create_radiometric_capture(
            device_id=device, settings={"frames": frames, "levels": levels}
        )
        while session.next is not None:
            hint(session.instruction)
            answer = typer.prompt(
                "Enter captures, q ends", default="", show_default=False, err=True
            )
            if answer.strip().lower() == "q":
                hint(f"session {session.id} stays as it is")
                raise typer.Exit(1)
            with progress("capturing", quiet=as_json):
                session = _captured(client, session, temperature_c)
        created = client.create_radiometric_calibration(
            id=radiometric_id,
            device_id=device,
            source={"kind": "capture", "radiometric_capture_id": session.id},
        )
    _print_created(created, as_json=as_json)


def _captured(
    client: Any, session: RadiometricCapture, temperature_c: float | None
) -> RadiometricCapture:
    """Return the session after its next capture, or as it was where that is refused."""
    from lumiline.client.errors import ServerProblem

    try:
        capture: RadiometricCapture = client.capture_radiometric_frames(
            session.id, kind=session.next, temperature_c=temperature_c
        )
    except ServerProblem as problem:
        if problem.code != "unusable-radiometric-capture":
            raise
        hint(f"[yellow]{escape(problem.detail)}[/yellow]")
        return session
    return capture


@radiometric_calibration.command("upload")
def upload(
    file: Annotated[Path, typer.Argument(help="JSON file of `estimate`.")],
    device: Annotated[str, typer.Argument(help="The device that it is for.")],
    radiometric_id: NewId = None,
    note: Annotated[str, typer.Option(help="For people.")] = "",
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Store an estimated calibration on a server; it is not activated."""
    content = read_json(file)
    sensors = content.get("sensors") if isinstance(content, dict) else None
    if not isinstance(sensors, dict):
        raise fail(f"{file} holds no radiometric calibration; `estimate --output` writes one")
    with client_session(url, key) as client:
        created = client.create_radiometric_calibration(
            id=radiometric_id,
            device_id=device,
            source={"kind": "document", "sensors": sensors},
            note=note,
        )
    _print_created(created, as_json=as_json)


@radiometric_calibration.command("activate")
def activate(
    radiometric_id: RadiometricId, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """Find the peaks of its device with it, from the next frame on."""
    with client_session(url, key) as client:
        activation = client.activate_radiometric_calibration(radiometric_id)
    if as_json:
        print_json(activation)
    else:
        say(f"device {activation.device_id} uses {activation.id}")


@radiometric_calibration.command("deactivate")
def deactivate(
    radiometric_id: RadiometricId, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """Let its device go on without it."""
    with client_session(url, key) as client:
        deactivation = client.deactivate_radiometric_calibration(radiometric_id)
    if as_json:
        print_json(deactivation)
    else:
        say(f"device {deactivation.device_id} does not use {deactivation.id}")


def _print_created(created: RadiometricCalibrationSummary, *, as_json: bool) -> None:
    if as_json:
        print_json(created)
        return
    console.print(_figures([one.model_dump() for one in created.sensors], created.id))
    say(f"stored as {created.id}; `lumiline radiometric-calibration activate {created.id}` uses it")


def _figures(sensors: list[dict[str, Any]], title: str) -> Table:
    headings = (
        "sensor", "gain, e/count", "offset,\ncounts", "read noise,\ncounts", "PRNU",
        "DSNU,\ncounts", "linearity\nerror", "bad pixels",
    )  # fmt: skip
    rows = (
        (
            one["sensor"], f"{one['gain_electrons_per_count']:.4g}",
            f"{one['dark_offset_counts']:.4g}", f"{one['read_noise_counts']:.3g}",
            f"{one['prnu']:.2%}", f"{one['dsnu_counts']:.3g}", spec(one["linearity_error"], ".2%"),
            one["bad_pixels"],
        )
        for one in sensors
    )  # fmt: skip
    return make_table(headings, rows, title)
