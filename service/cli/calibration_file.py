"""Reads a calibration from a JSON file of `lumiline calibrate` or of the service."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from service.api.calibrations.calibration_content import content_hash

DOCUMENT: Final = TypeAdapter(Calibration)


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """What the file holds.

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
    """Read a calibration from a file.

    Raises:
        InvalidParameter: the file cannot be read, or holds no calibration.
    """
    try:
        content: Any = json.loads(path.read_bytes())
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InvalidParameter(f"{path} is not JSON: {error}") from error
    sent = isinstance(content, dict) and "result" in content
    try:
        calibration = DOCUMENT.validate_python(content["result"] if sent else content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        raise InvalidParameter(
            f"{path} holds no calibration: {place}: {first['msg']}; `lumiline calibrate --output` "
            "writes one, and GET /api/v1/calibrations/{id} sends one"
        ) from error
    if sent:
        return CalibrationFile(
            calibration, str(content.get("content_hash", "")), str(content.get("device", ""))
        )
    return CalibrationFile(calibration, result_hash(calibration))


def result_hash(calibration: Calibration) -> str:
    """Return the SHA-256 of a calibration's canonical JSON: sorted keys, no spaces, UTF-8."""
    return content_hash(DOCUMENT.dump_python(calibration, mode="json"))
