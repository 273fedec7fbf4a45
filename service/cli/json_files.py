"""Reads JSON files of commands: calibrations, tools, devices, settings."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from service.api.calibrations.calibration_content import content_hash
from service.pipeline.active_calibration import ActiveCalibration

T = TypeVar("T")

DOCUMENT: Final = TypeAdapter(Calibration)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; raises InvalidParameter."""
    try:
        return json.loads(_read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise InvalidParameter(f"{path} is not JSON: {error}") from error


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror or error}") from error


def validate(adapter: TypeAdapter[T], content: Any, path: Path, what: str, hint: str) -> T:
    """Return a file's content as a type; raises InvalidParameter with the first error and a hint.

    Args:
        adapter: of the type.
        content: the file's content.
        path: the file.
        what: the file holds where the content is not of the type: "no calibration".
        hint: what it must be.
    """
    try:
        return adapter.validate_python(content)
    except ValidationError as error:
        raise InvalidParameter(
            f"{path} holds {what}: {error_messages(error)[0]}; {hint}"
        ) from error


def error_messages(error: ValidationError) -> list[str]:
    """Return the place and the message of each error."""
    return [
        f"{'.'.join(map(str, one['loc'])) or 'the whole'}: {one['msg']}" for one in error.errors()
    ]


def read_settings(kind: type[T], path: Path | None) -> T:
    """Return the settings of a simulation in a JSON file, or the defaults without a file.

    Raises:
        InvalidParameter: the file cannot be read, or a setting is wrong.
    """
    try:
        return TypeAdapter(kind).validate_json(b"{}" if path is None else _read_bytes(path))
    except ValidationError as error:
        raise InvalidParameter(f"{path}: {'; '.join(error_messages(error))}") from error


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """A calibration of `lumiline calibrate` or of the service.

    Args:
        calibration: the calibration.
        content_hash: what a correction table names as its parent: the service's hash of a
            calibration that it sent, otherwise the SHA-256 of the result's canonical JSON.
        device: the device that it is of; empty where the file does not say.
    """

    calibration: Calibration
    content_hash: str
    device: str = ""


def read_calibration(path: Path) -> CalibrationFile:
    """Read a calibration from a file; raises InvalidParameter."""
    content = read_json(path)
    sent = isinstance(content, dict) and "result" in content
    calibration = validate(
        DOCUMENT, content["result"] if sent else content, path, "no calibration",
        "`lumiline calibrate --output` writes one, and GET /api/v1/calibrations/{id} sends one",
    )  # fmt: skip
    if sent:
        return CalibrationFile(
            calibration, str(content.get("content_hash", "")), str(content.get("device_id", ""))
        )
    canonical = DOCUMENT.dump_python(calibration, mode="json")
    return CalibrationFile(calibration, content_hash(canonical))


def read_active_calibration(
    calibration: Path | None, table: Path | None
) -> ActiveCalibration | None:
    """Return the calibration and correction table of these files; None: none are given."""
    from service.api.correction_tables.hdf5_file import read_table

    if calibration is None:
        if table is not None:
            raise InvalidParameter(
                "--table needs the table's calibration: give it with --calibration"
            )
        return None
    calibration_file = read_calibration(calibration)
    if table is None:
        return ActiveCalibration(str(calibration), calibration_file.calibration, None, None)
    corrections = read_table(_read_bytes(table)).table
    if corrections.calibration_hash != calibration_file.content_hash:
        raise InvalidParameter(
            f"the table {table} was made for the calibration with the hash "
            f"{corrections.calibration_hash}; {calibration} has {calibration_file.content_hash}"
        )
    return ActiveCalibration(
        str(calibration), calibration_file.calibration, str(table), corrections
    )
