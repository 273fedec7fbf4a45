"""`lumiline peaks`: peaks of scans in a file, as a table, JSON or a plot."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer
from pydantic import TypeAdapter, ValidationError
from rich.markup import escape
from rich.table import Table

from compute.errors import InvalidParameter, LumilineError
from service.api.line_scans.chain_steps import passive_chain
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.methods import WIDEST_SPREAD, FitMethod, Method, MethodName
from service.api.line_scans.noise import NoiseConstants
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.schema import LinePeak, LineScan, LineScans, PixelNoise
from service.cli.output import console, fail
from service.cli.scan_files import ScanFile, read_scans

if TYPE_CHECKING:
    from hardware.driver import DeviceDescription

METHOD: TypeAdapter[Method] = TypeAdapter(Method)


def run(
    path: Path,
    *,
    scan: int | None,
    frame: int | None,
    sensor: str | None,
    method: str | None,
    width_px: float | None,
    further_peaks: bool | None,
    settings: Path | None,
    noise: dict[str, float | None],
    output: Path | None,
    as_json: bool,
    detail: bool,
) -> None:
    """Find and print the peaks of a file's lines; draw the first of them where wanted."""
    if output is not None and not output.parent.is_dir():
        raise fail(f"{output} cannot be written: there is no folder {output.parent}")
    if output is not None and output.suffix.lower() != ".png":
        raise fail(f"{output} cannot be written: pictures are PNG, and their names end in .png")
    if detail and not as_json:
        raise fail("--detail is for --json; give both, or --output for a picture")
    try:
        read = read_scans(path, scan=scan, frame=frame, sensor=sensor)
        if settings is not None:
            chosen = _from_file(settings)
        elif read.device is not None and width_px is None and further_peaks is None:
            chosen = recorded_method(method, read.device, read.sensors)
        else:
            chosen = _named(method or "fit", width_px, further_peaks)
        found = find_peaks(read.scans, chosen, _noise(noise, read.noise), detail=detail)
        if output is not None:
            _draw(read, chosen, found, output)
    except LumilineError as error:
        raise fail(escape(error.detail)) from error
    if as_json:
        numbered = [
            scan.model_copy(
                update={
                    "index": read.first + scan.index,
                    "sensor": read.sensors[scan.index] if read.sensors else None,
                }
            )
            for scan in found.scans
        ]
        typer.echo(found.model_copy(update={"scans": numbered}).model_dump_json(indent=2))
        return
    _print(found, read.names)
    if output is not None:
        console.print(f"written: {output}")


def _named(name: str, width_px: float | None = None, further: bool | None = None) -> Method:
    """Return a method with its defaults.

    The chain is the one for passive markers, which takes the background away: others leave it
    to whoever knows that there is none.
    """
    if name not in get_args(MethodName):
        raise fail(f'the method is "{name}"; it must be one of {", ".join(get_args(MethodName))}')
    if width_px is not None and name not in ("fit", "matched"):
        raise fail(f"--width is for the methods fit and matched, not for {name}")
    if further is not None and name != "fit":
        raise fail(f"--further-peaks is for the method fit, not for {name}")
    if name == "chain":
        return passive_chain()
    given = {"width_px": width_px, "further_peaks": further}
    known = {option: value for option, value in given.items() if value is not None}
    if name == "mask":
        raise fail(
            "the method mask has to know the shadow: give it by --settings, as "
            '{"method": "mask", "profile": "coda-mpx30"}'
        )
    return _valid({"method": name, **known}, "--width")


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

    own = peak_method(device)
    if name is None and own is None:
        raise InvalidParameter(
            "the lines are the outputs behind a plate with Gray tracks, which have no peaks; with "
            "--method they are measured all the same"
        )
    if name == "mask" or (name is None and own == "shadow"):
        return _recorded_mask(device, sensors)
    if name is None:
        name = own if own == "centroid" else "fit"
    if name != "fit":
        return _named(name)
    width = device.line_sigma_px
    if width is not None and own == "fit":
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
    return MaskMethod(profile=device.profile, sensors=list(names), fit_scale=True)


def _from_file(path: Path) -> Method:
    try:
        return METHOD.validate_json(path.read_bytes(), strict=True)
    except (OSError, ValidationError) as error:
        raise fail(escape(_message(error, str(path)))) from error


def _valid(values: dict[str, Any], name: str) -> Method:
    try:
        return METHOD.validate_python(values)
    except ValidationError as error:
        raise fail(escape(_message(error, name))) from error


def _noise(
    given: dict[str, float | None], recorded: PixelNoise | None
) -> PixelNoise | NoiseConstants | None:
    """Return the noise of the options, else of the recording; None: neither has it."""
    values = {name: value for name, value in given.items() if value is not None}
    if not values:
        return recorded
    try:
        if recorded is not None:
            return PixelNoise.model_validate({**recorded.model_dump(), **values})
        known = {"offset_counts", "full_scale_counts"}
        if values.keys() <= known:
            # Checked as if the rest were known, too.
            full = PixelNoise.model_validate(
                {"electrons_per_count": 1.0, "read_noise_electrons": 0.0, **values}
            )
            return NoiseConstants(**full.model_dump(include=set(values)))
        return PixelNoise.model_validate(values)
    except ValidationError as error:
        text = _message(error, "noise")
        raise fail(escape(f"{text}; give --gain and --read-noise, or neither")) from error


def _message(error: Exception, where: str) -> str:
    if not isinstance(error, ValidationError):
        return f"{where}: {error.strerror if isinstance(error, OSError) else error}"
    parts = (
        f"{'.'.join(map(str, one['loc'])) or 'the whole'}: {one['msg']}" for one in error.errors()
    )
    return f"{where}: {'; '.join(parts)}"


def _draw(read: ScanFile, method: Method, found: LineScans, output: Path) -> None:
    from service.api.line_scans.plot import draw_scan

    count = getattr(method, "average", None) or 1
    detailed = find_peaks(read.scans[:count], method, found.noise, detail=True)
    first = found.model_copy(update={"scans": detailed.scans})
    try:
        output.write_bytes(draw_scan(read.scans[0], first, method, read.names[0]))
    except OSError as error:
        raise fail(f"{output} cannot be written: {error.strerror}") from error


def _print(found: LineScans, names: tuple[str, ...]) -> None:
    for scan in found.scans:
        console.print(_heading(scan, names[scan.index]), highlight=False)
        if scan.peaks:
            console.print(_table(scan))
        console.print()
    noise = found.noise
    console.print(
        f"noise: {noise.electrons_per_count:.3g} electrons per count, read noise "
        f"{noise.read_noise_electrons:.3g} electrons, offset {noise.offset_counts:g} counts, full "
        f"scale {noise.full_scale_counts} counts",
        highlight=False,
    )
    split = sum(scan.further_peaks or 0 for scan in found.scans)
    if split:
        console.print(
            f"- further peaks, added because the pixels ask for them: {split}. A line that is not "
            "Gaussian is split so, too; --no-further-peaks fits one for each that is seen",
            highlight=False,
        )
    for text in found.assumed:
        console.print(f"- guessed: {text}", highlight=False)


def _heading(scan: LineScan, name: str) -> str:
    count = len(scan.peaks)
    limit = ""
    if scan.limit_counts is not None:
        limit = f"; peaks must reach {scan.limit_counts:.4g} counts"
    elif scan.limit_sigma is not None:
        limit = f"; answers must be above {scan.limit_sigma:.3g} deviations"
    full = f"; {scan.saturated_pixels} pixels saturated" if scan.saturated_pixels else ""
    return (
        f"[bold]{escape(name)}: {count or 'no'} peak{'' if count == 1 else 's'}[/bold]; background "
        f"{scan.background_counts:.5g} counts, noise {scan.noise_counts:.3g} counts (measured "
        f"{scan.measured_noise_counts:.3g}){limit}{full}"
    )


def _table(scan: LineScan) -> Table:
    table = Table()
    columns = _columns(scan)
    table.add_column("", justify="right")
    for heading in columns:
        table.add_column(heading, justify="left" if heading == "flags" else "right")
    for number, peak in enumerate(scan.peaks, start=1):
        table.add_row(str(number), *(_cell(peak, field) for field in columns.values()))
    return table


def _columns(scan: LineScan) -> dict[str, str]:
    """Return headings and fields, without those of which this line's peaks have nothing."""
    every = {
        "position,\npx": "position_px",
        "deviation,\npx": "sigma_px",
        "answer,\ndeviations": "response_sigma",
        "height,\ncounts": "amplitude",
        "width,\npx": "width_px",
        "chi2 /\nfreedom": "reduced_chi2",
        "flags": "flags",
    }
    return {
        heading: field
        for heading, field in every.items()
        if field in ("position_px", "flags")
        or any(getattr(peak, field) is not None for peak in scan.peaks)
    }


def _cell(peak: LinePeak, field: str) -> str:
    value = getattr(peak, field)
    match field:
        case "flags":
            return ", ".join(value)
        case "position_px":
            return f"{value:.4f}" if peak.sigma_px is not None else f"{value:g}"
        case _:
            return "-" if value is None else f"{value:.4g}" if value < 1e4 else f"{value:.0f}"
