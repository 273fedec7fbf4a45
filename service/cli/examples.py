"""`lumiline examples`: small files to try the commands with, from the simulated rig."""

import csv
import io
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models
from service.cli.json_files import DOCUMENT
from service.cli.options import AsJson, Force
from service.cli.output import check_folder, check_output, file_errors, print_json, write_file

Array = NDArray[np.float64]

SIGMA_PX: Final = 0.05
WAND_MM: Final = 300.0
POSES: Final = 120
VOLUME_POINTS: Final = 200
_WAVED_MM: Final = 150.0
_VOLUME_MM: Final = 250.0


def examples(
    folder: Annotated[Path, typer.Argument(help="Folder to write them to; made if need be.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the readings' noise.")] = 1,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Write waved.csv, volume.csv, nominal.json and my-bar.toml."""
    from service.application.initial_content import nominal_calibration

    profile = resources.files("compute.optics.profiles") / "devices" / "bar.toml"
    rng = np.random.default_rng(seed)
    files = {
        "waved.csv": _waved(rng),
        "volume.csv": _volume(rng),
        "nominal.json": DOCUMENT.dump_json(nominal_calibration(), indent=2) + b"\n",
        "my-bar.toml": profile.read_text("utf-8").replace('"bar"', '"my-bar"', 1).encode(),
    }
    check_folder(folder)
    with file_errors(folder):
        folder.mkdir(exist_ok=True)
    for name in files:
        check_output(folder / name, force=force)
    for name, content in files.items():
        write_file(folder / name, content, quiet=as_json)
    if as_json:
        print_json({"files": [str(folder / name) for name in files]})


def _waved(rng: np.random.Generator) -> bytes:
    """Return a wand of two markers, waved in all directions around the working centre."""
    centre = WORKING_CENTRE_MM + rng.uniform(-_WAVED_MM, _WAVED_MM, (POSES, 3))
    half = rng.normal(size=(POSES, 3))
    half *= WAND_MM / 2.0 / np.linalg.norm(half, axis=1, keepdims=True)
    ends = np.stack([centre - half, centre + half], axis=1).reshape(-1, 3)
    identifiers = [[row // 2 + 1, row % 2 + 1] for row in range(len(ends))]
    return _csv(["pose", "marker"], identifiers, _readings(rng, ends))


def _volume(rng: np.random.Generator) -> bytes:
    """Return known points all over the working volume."""
    points = WORKING_CENTRE_MM + rng.uniform(-_VOLUME_MM, _VOLUME_MM, (VOLUME_POINTS, 3))
    points = points.round(2)
    return _csv(["X_mm", "Y_mm", "Z_mm"], points.tolist(), _readings(rng, points))


def _readings(rng: np.random.Generator, points_mm: Array) -> Array:
    """Return noisy readings, shape (N, S) [px]; NaN where they fall beside the pixels."""
    models = simulated_sensor_models()
    readings = CameraStack.of(models).project(points_mm)
    readings += rng.normal(0.0, SIGMA_PX, readings.shape)
    pixels = np.array([model.pixels for model in models])
    return np.where((readings >= 0.0) & (readings <= pixels - 1), readings, np.nan)


def _csv(heading: list[str], identifiers: Sequence[Sequence[float]], readings_px: Array) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [model.name for model in simulated_sensor_models()]
    ends = ("_px", "_sigma_px")
    writer.writerow([*heading, *(f"{name}{end}" for name in names for end in ends)])
    for identifier, row in zip(identifiers, readings_px.tolist(), strict=True):
        cells = (("", "") if np.isnan(one) else (f"{one:.3f}", SIGMA_PX) for one in row)
        writer.writerow([*identifier, *(cell for pair in cells for cell in pair)])
    return text.getvalue().encode()
