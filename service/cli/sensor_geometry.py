"""Pixels and pitch of each sensor of a CSV file: of a device, of a profile, or one by one."""

from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import typer
from pydantic import TypeAdapter, ValidationError

from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from service.api.devices.schema import Sensor
from service.cli.json_files import error_messages, read_json, validate
from service.cli.observations_csv import ReadingTable
from service.cli.options import complete_profile

T = TypeVar("T", bound=ReadingTable)

SensorsOption = Annotated[
    str | None,
    typer.Option(
        help="The sensors: a device as JSON, as the service takes and sends it; a device profile; "
        "or NAME=PIXELS@PITCH_UM of each, as 'cam1=480@10.58,cam2=640'.",
        autocompletion=complete_profile,
    ),
]
PixelsOption = Annotated[
    int | None, typer.Option(min=8, help="Pixels of each sensor, where all have as many.")
]
_EXAMPLE: Final = "cam1=480@10.58,cam2=640"
_SENSORS: Final = TypeAdapter(list[Sensor])
_SENSOR: Final = TypeAdapter(Sensor)


def with_geometry(
    table: T, sensors: str | None, pixels: int | None, pitch_um: float | None = None
) -> tuple[T, tuple[SensorGeometry, ...]]:
    """Return a file's readings in the order of its sensors, and the sensors.

    Args:
        table: the file's content.
        sensors: what --sensors gives; None: not given, and all sensors are alike.
        pixels: of each sensor.
        pitch_um: of each sensor [um]; None: not known.

    Raises:
        InvalidParameter: neither is given, --sensors cannot be read, or its sensors are not those
            of the file.
    """
    if sensors is None:
        if pixels is None:
            raise InvalidParameter(
                "the sensors' pixels are not known: give --sensors with a device's JSON file or "
                f"as {_example(table)}, or --pixels where all have as many"
            )
        return table, tuple(SensorGeometry(name, pixels, pitch_um) for name in table.sensors)
    given = read_sensors(sensors)
    names = [one.name for one in given]
    missing = [name for name in table.sensors if name not in names]
    without = [name for name in names if name not in table.sensors]
    if missing or without:
        raise InvalidParameter(
            f"{table.path} has readings of {', '.join(table.sensors)}, and --sensors has "
            f"{', '.join(names)}: "
            + (f"add {', '.join(missing)} to --sensors" if missing else "")
            + (" and " if missing and without else "")
            + (f"leave {', '.join(without)} out of it, or add its readings" if without else "")
            + "; a column's name is its sensor's, then _px"
        )
    return table.in_order_of(given, "--sensors"), given


def read_sensors(text: str) -> tuple[SensorGeometry, ...]:
    """Return the sensors of a file, of a built-in profile, or of a list.

    Raises:
        InvalidParameter: it is none of these, or a name or a number is wrong.
    """
    path = Path(text)
    if "=" in text and not path.is_file():
        given = [_listed_sensor(part.strip(), text) for part in text.strip(", ").split(",")]
    elif path.suffix.lower() == ".json":
        given = [SensorGeometry(**vars(one)) for one in _of_device(path)]
    else:
        from compute.optics.profiles.profile_loader import load_profile, profile_names

        if text not in profile_names() and not path.is_file():
            raise InvalidParameter(
                f'--sensors is "{text}", which is neither a file nor the name of a profile; give a '
                f"device's JSON file, a profile, or the sensors as {_EXAMPLE}"
            )
        profile = load_profile(text)
        given = [
            SensorGeometry(one.name, profile.pixels.count, profile.pixels.pitch_um)
            for one in profile.sensors
        ]
    names = [one.name for one in given]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InvalidParameter(f'--sensors has "{twice}" twice; give each sensor once')
    return tuple(given)


def _listed_sensor(part: str, text: str) -> SensorGeometry:
    name, equals, numbers = part.partition("=")
    pixels, at, pitch = numbers.partition("@")
    content: dict[str, Any] = {"name": name.strip(), "pixels": pixels.strip()}
    content["pitch_um"] = pitch.strip() if at else 1.0
    try:
        checked = _SENSOR.validate_python(content)
    except ValidationError as error:
        reason = "" if not equals else f" ({error_messages(error)[0]})"
        raise InvalidParameter(
            f'--sensors is "{text}"; "{part}" must be a sensor\'s name, its pixels and, where it '
            f"is known, its pitch in um{reason}, as {_EXAMPLE}"
        ) from None
    return SensorGeometry(checked.name, checked.pixels, checked.pitch_um if at else None)


def _of_device(path: Path) -> list[Sensor]:
    content = read_json(path)
    listed = content.get("sensors") if isinstance(content, dict) else None
    if listed is None and isinstance(content, dict) and isinstance(content.get("source"), dict):
        listed = content["source"].get("sensors")
    if not listed:
        raise InvalidParameter(
            f"{path} names no sensors; it must be a device as GET /api/v1/devices/{{id}} sends it, "
            'or an external one as POST /api/v1/devices takes it: {"sensors": [{"name": "cam1", '
            '"pixels": 480, "pitch_um": 10.58}, ...]}'
        )
    return validate(
        _SENSORS, listed, path, "no sensors",
        'a sensor is {"name": "cam1", "pixels": 480, "pitch_um": 10.58}',
    )  # fmt: skip


def _example(table: ReadingTable) -> str:
    return ",".join(f"{name}=480@10.58" for name in table.sensors[:2]) + (
        ",..." if len(table.sensors) > 2 else ""
    )
