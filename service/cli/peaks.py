"""`lumiline peaks`: peaks of scans in a file, as a table, JSON or a plot."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, get_args

import typer
from pydantic import TypeAdapter, ValidationError
from rich.markup import escape
from rich.table import Table

from compute.errors import InvalidParameter
from service.api.line_scans.chain_steps import passive_chain
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.methods import WIDEST_SPREAD, FitMethod, Method, MethodName
from service.api.line_scans.noise import NoiseConstants
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.schema import LinePeak, LineScan, LineScans, PixelNoise
from service.cli.json_files import error_messages
from service.cli.options import AsJson, Force, refuse_unused
from service.cli.output import (
    atomic_file,
    check_output,
    console,
    fail,
    make_table,
    progress,
    say,
    say_written,
    spec,
)
from service.cli.scan_files import ScanFile, read_scans

if TYPE_CHECKING:
    from hardware.driver import DeviceDescription

METHOD: Final[TypeAdapter[Method]] = TypeAdapter(Method)


def peaks(
    context: typer.Context,
    file: Annotated[
        Path, typer.Argument(help="CSV (one scan of counts a row), .npy (L, P), or a recording.")
    ],
    scan: Annotated[int | None, typer.Option(min=0, help="Only this scan, from 0.")] = None,
    exposure: Annotated[
        int | None, typer.Option(min=0, help="Of a recording: this exposure, from 0.")
    ] = None,
    sensor: Annotated[str | None, typer.Option(help="Of a recording: only this one.")] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="centroid, fit, chain, matched or mask; left out: the recording's, or fit."
        ),
    ] = None,
    line_sigma_px: Annotated[
        float | None, typer.Option(help=r"Standard deviation of the lines \[px]: fit, matched.")
    ] = None,
    further_peaks: Annotated[
        bool | None, typer.Option(help="Fit: more peaks than are seen; left out: with a width.")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Method and settings as JSON, as REST takes them.")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Electrons per count.")] = None,
    read_noise: Annotated[float | None, typer.Option(help="Read noise, electrons.")] = None,
    offset: Annotated[float | None, typer.Option(help="The count without light.")] = None,
    full_scale: Annotated[int | None, typer.Option(help="The count of a saturated pixel.")] = None,
    output: Annotated[
        Path | None, typer.Option(help="Draw the (first) scan: a PNG to write.")
    ] = None,
    as_json: AsJson = False,
    detail: Annotated[
        bool, typer.Option("--detail", help="In JSON: also model, residuals, steps.")
    ] = False,
    force: Force = False,
) -> None:
    """Find and print the peaks of a file's scans; draw the first of them where wanted."""
    check_output(output, force=force)
    if output is not None and output.suffix.lower() != ".png":
        raise fail(f"{output} cannot be written: pictures are PNG, and their names end in .png")
    if not as_json:
        refuse_unused(context, "without --json", "detail")
    if output is None:
        refuse_unused(context, "without --output", "force")
    if settings is not None:
        why = "with --settings, which has the method"
        refuse_unused(context, why, "method", "line_sigma_px", "further_peaks")
    noise = {
        "electrons_per_count": gain,
        "read_noise_electrons": read_noise,
        "offset_counts": offset,
        "full_scale_counts": full_scale,
    }
    read = read_scans(file, scan=scan, exposure=exposure, sensor=sensor)
    if settings is not None:
        chosen = _from_file(settings)
    elif read.device is not None and line_sigma_px is None and further_peaks is None:
        chosen = recorded_method(method, read.device, read.sensors)
    else:
        chosen = _named(method or "fit", line_sigma_px, further_peaks)
    with progress("finding peaks", quiet=as_json):
        result = find_peaks(read.scans, chosen, _noise(noise, read.noise), detail=detail)
    if output is not None:
        _draw(read, chosen, result, output)
    if as_json:
        numbered = [
            one.model_copy(
                update={
                    "index": read.first + one.index,
                    "sensor": read.sensors[one.index] if read.sensors else None,
                }
            )
            for one in result.scans
        ]
        typer.echo(result.model_copy(update={"scans": numbered}).model_dump_json(indent=2))
        return
    _print(result, read.names)
    if output is not None:
        say_written(output)


def _named(name: str, width_px: float | None = None, further: bool | None = None) -> Method:
    """Return a method with its defaults.

    The chain is the one for passive markers, which takes the background away: others leave it
    to whoever knows that there is none.
    """
    if name not in get_args(MethodName):
        raise fail(f'the method is "{name}"; it must be one of {", ".join(get_args(MethodName))}')
    if width_px is not None and name not in ("fit", "matched"):
        raise fail(f"--line-sigma-px is for the methods fit and matched, not for {name}")
    if further is not None and name != "fit":
        raise fail(f"--further-peaks is for the method fit, not for {name}")
    if name == "chain":
        return passive_chain()
    options = {"width_px": width_px, "further_peaks": further}
    set_options = {option: value for option, value in options.items() if value is not None}
    if name == "mask":
        raise fail(
            "the method mask has to know the shadow: give it by --settings, as "
            '{"method": "mask", "profile": "coda-mpx30"}'
        )
    with _refusals("--line-sigma-px"):
        return METHOD.validate_python({"method": name, **set_options})


def recorded_method(
    name: str | None, device: "DeviceDescription", sensors: tuple[str, ...] | None = None
) -> Method:
    """Return a method with the settings that the device's lines are measured with live.

    Args:
        name: of the method; None: the device's own, and "fit" where it has none for lines.
        device: that the lines were recorded from.
        sensors: whose lines there are; None: of all sensors.

    Raises:
        InvalidParameter: the lines have no peaks, or what their shadows are like is not known.
    """
    from service.pipeline.detection_stage import FREE_WIDTH_FIT, peak_method

    device_method = peak_method(device)
    if name is None and device_method is None:
        raise InvalidParameter(
            "the lines are the outputs behind a plate with Gray tracks, which have no peaks; with "
            "--method they are measured all the same"
        )
    if name == "mask" or (name is None and device_method == "shadow"):
        return _recorded_mask(device, sensors)
    if name is None:
        name = device_method if device_method == "centroid" else "fit"
    if name != "fit":
        return _named(name)
    width = device.line_sigma_px
    if width is not None and device_method == "fit":
        return FitMethod(width_px=width, width_log_sigma=0.0)
    return FitMethod(
        width_log_sigma=WIDEST_SPREAD,
        max_joint_peaks=FREE_WIDTH_FIT.max_joint_peaks,
        further_peaks=FREE_WIDTH_FIT.further_peaks,
    )


def _recorded_mask(device: "DeviceDescription", sensors: tuple[str, ...] | None) -> MaskMethod:
    """Return the method of shadows as it is live: with the profile's, magnified as they are."""
    if device.readout != "coded-window" or device.profile is None:
        why = "names no profile" if device.readout == "coded-window" else "has no coded windows"
        raise InvalidParameter(
            f"the recorded device {why}, which the method mask takes the shadow from; give a "
            "template by --settings"
        )
    names = sensors or tuple(sensor.name for sensor in device.sensors)
    return MaskMethod(profile_id=device.profile, sensors=list(names), fit_scale=True)


def _from_file(path: Path) -> Method:
    with _refusals(str(path)):
        return METHOD.validate_json(path.read_bytes(), strict=True)


@contextmanager
def _refusals(where: str, hint: str = "") -> Iterator[None]:
    """End the command where settings are wrong, or their file cannot be read."""
    try:
        yield
    except ValidationError as error:
        raise fail(f"{where}: {'; '.join(error_messages(error))}{hint}") from error
    except OSError as error:
        raise fail(f"{where}: {error.strerror}") from error


def _noise(
    options: dict[str, float | None], recorded: PixelNoise | None
) -> PixelNoise | NoiseConstants | None:
    """Return the noise of the options, else of the recording; None: neither has it."""
    values = {name: value for name, value in options.items() if value is not None}
    if not values:
        return recorded
    with _refusals("noise", "; give --gain and --read-noise, or neither"):
        if recorded is not None:
            return PixelNoise.model_validate({**recorded.model_dump(), **values})
        allowed = {"offset_counts", "full_scale_counts"}
        if values.keys() <= allowed:
            # Checked as if the rest were known, too.
            full = PixelNoise.model_validate(
                {"electrons_per_count": 1.0, "read_noise_electrons": 0.0, **values}
            )
            return NoiseConstants(**full.model_dump(include=set(values)))
        return PixelNoise.model_validate(values)


def _draw(read: ScanFile, method: Method, result: LineScans, output: Path) -> None:
    from service.api.line_scans.plot import draw_scan

    count = getattr(method, "average", None) or 1
    detailed = find_peaks(read.scans[:count], method, result.noise, detail=True)
    first = result.model_copy(update={"scans": detailed.scans})
    with atomic_file(output) as temporary:
        temporary.write_bytes(draw_scan(read.scans[0], first, method, read.names[0]))


def _print(result: LineScans, names: tuple[str, ...]) -> None:
    for scan in result.scans:
        say(_heading(scan, names[scan.index]))
        if scan.peaks:
            console.print(_table(scan))
        console.print()
    noise = result.noise
    say(
        f"noise: {noise.electrons_per_count:.3g} electrons per count, read noise "
        f"{noise.read_noise_electrons:.3g} electrons, offset {noise.offset_counts:g} counts, full "
        f"scale {noise.full_scale_counts} counts"
    )
    split = sum(scan.further_peaks or 0 for scan in result.scans)
    if split:
        say(
            f"- further peaks, added because the pixels ask for them: {split}. A line that is not "
            "Gaussian is split so, too; --no-further-peaks fits one for each that is seen"
        )
    for text in result.assumed:
        say(f"- guessed: {text}")


def _heading(scan: LineScan, name: str) -> str:
    count = len(scan.peaks)
    limit = ""
    if scan.limit_counts is not None:
        limit = f"; peaks must reach {scan.limit_counts:.4g} counts"
    elif scan.limit_sigma is not None:
        limit = f"; the response must exceed {scan.limit_sigma:.3g} sigma"
    full = f"; {scan.saturated_pixels} pixels saturated" if scan.saturated_pixels else ""
    return (
        f"[bold]{escape(name)}: {count or 'no'} peak{'' if count == 1 else 's'}[/bold]; background "
        f"{scan.background_counts:.5g} counts, noise {scan.noise_counts:.3g} counts (measured "
        f"{scan.measured_noise_counts:.3g}){limit}{full}"
    )


_COLUMNS: Final = {
    "position_px": "position,\npx",
    "sigma_px": "sigma,\npx",
    "response_sigma": "response,\nsigma",
    "amplitude": "height,\ncounts",
    "width_px": "width,\npx",
    "reduced_chi2": "chi2 /\ndof",
    "flags": "flags",
}


def _table(scan: LineScan) -> Table:
    """Return the peaks of a scan, without the columns that are empty."""
    fields = [
        field
        for field in _COLUMNS
        if field in ("position_px", "flags")
        or any(getattr(peak, field) is not None for peak in scan.peaks)
    ]
    rows = (
        [number, *(_cell(peak, field) for field in fields)]
        for number, peak in enumerate(scan.peaks, start=1)
    )
    table = make_table(["", *(_COLUMNS[field] for field in fields)], rows, texts=0)
    table.columns[-1].justify = "left"
    return table


def _cell(peak: LinePeak, field: str) -> str | None:
    value = getattr(peak, field)
    match field:
        case "flags":
            return ", ".join(value)
        case "position_px":
            return f"{value:.4f}" if peak.sigma_px is not None else f"{value:g}"
        case _:
            return spec(value, ".4g" if value is None or value < 1e4 else ".0f")
