"""Active calibration in a recording: the calibration as JSON, its correction table as HDF5."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from compute.calibration.result import Calibration
from compute.errors import InvalidRecording, LumilineError
from hardware.damaged_file import refusing_damage
from service.api.calibrations.calibration_content import content_hash
from service.api.correction_tables.table_content import TableContent
from service.api.radiometric_calibrations.content import content_of
from service.pipeline.active_calibration import (
    NO_ACTIVE_CALIBRATION,
    ActiveCalibration,
    ActiveRadiometric,
    LiveBadPixel,
)

_RESULT: Final = TypeAdapter(Calibration)
_NOT_HASHED: Final = {"id", "content_hash", "table", "radiometric", "bad_pixels"}
_IDS: Final = {"calibration_id": "id", "content_hash": "content_hash", "table_id": "table"}
"""Members of a document that name something, as ActiveCalibrationNames calls them."""
_BAD_PIXELS: Final = TypeAdapter(tuple[LiveBadPixel, ...])


def dump_active_calibration(found: ActiveCalibration) -> tuple[bytes, bytes]:
    """Return the calibration's document and the table's file; empty without them.

    The document has the members of the calibration's content (``result`` and, of one that the
    service stored, ``device``, ``provenance`` and ``points``), and ``id``, ``content_hash`` and
    ``table``, the table's id. `lumiline replay --calibration` takes it. A radiometric calibration
    is its member ``radiometric``, with ``id``, ``content_hash`` and ``content``, and pixels that
    the frames had shown to be bad are ``bad_pixels``; without another calibration they are the only
    ones.
    """
    radiometric = found.radiometric
    pixels: dict[str, Any] = {}
    if radiometric is not None:
        pixels["radiometric"] = {
            "id": radiometric.radiometric_id,
            "content_hash": radiometric.content_hash,
            "content": radiometric.content,
        }
    if found.bad_pixels:
        pixels["bad_pixels"] = _BAD_PIXELS.dump_python(found.bad_pixels, mode="json")
    if found.calibration is None:
        return (json.dumps(pixels, allow_nan=False).encode() if pixels else b""), b""
    content = found.calibration_content
    if content is None:
        result = _RESULT.dump_python(found.calibration, mode="json")
        content, own_hash = {"result": result}, content_hash(result)
    else:
        own_hash = found.calibration_hash or content_hash(dict(content))
    document = {
        **content,
        "id": found.calibration_id,
        "content_hash": own_hash,
        "table": found.table_id,
        **pixels,
    }
    table = found.table_file
    if table is None and found.table is not None:
        # The file library is loaded by who needs it.
        from service.api.correction_tables.hdf5_file import write_table

        unknown = datetime.fromtimestamp(0, UTC)
        table = write_table(TableContent(found.table, "", unknown, {}, {}))
    return json.dumps(document, allow_nan=False).encode(), table or b""


@dataclass(frozen=True)
class ActiveCalibrationNames:
    """Ids in the document of an active calibration; None: it has no such part.

    Args:
        calibration_id: of the calibration.
        content_hash: of the calibration.
        table_id: of its correction table.
        radiometric_id: of the radiometric calibration.
        bad_pixels: number of masked pixels.
    """

    calibration_id: str | None = None
    content_hash: str | None = None
    table_id: str | None = None
    radiometric_id: str | None = None
    bad_pixels: int = 0


def read_names(document: bytes, where: str) -> ActiveCalibrationNames:
    """Return the ids in the document of an active calibration.

    Args:
        document: as of ``dump_active_calibration``.
        where: the recording's name, for errors.

    Raises:
        InvalidRecording: it is no such document.
    """
    if not document:
        return ActiveCalibrationNames()
    radiometric, bad_pixels = load_pixels(document, where)
    found = json.loads(document)
    ids = {name: found.get(key) for name, key in _IDS.items()}
    for text in ids.values():
        if not isinstance(text, str | None):
            raise InvalidRecording(
                f"{where} holds an active calibration with the id or hash {text!r:.40}; it must be "
                "a text"
            )
    return ActiveCalibrationNames(
        **ids,
        radiometric_id=None if radiometric is None else radiometric.radiometric_id,
        bad_pixels=len(bad_pixels),
    )


def load_active_calibration(document: bytes, table: bytes, where: str) -> ActiveCalibration:
    """Return the active calibration that a recording holds.

    Args:
        document: as of ``dump_active_calibration``.
        table: likewise.
        where: the recording's name, for errors.

    Raises:
        InvalidRecording: the document is no calibration, or was changed after it was written.
        InvalidTableFile: the table is none.
    """
    if not document:
        return NO_ACTIVE_CALIBRATION
    radiometric, bad_pixels = load_pixels(document, where)
    if (radiometric or bad_pixels) and set(json.loads(document)) <= {"radiometric", "bad_pixels"}:
        return ActiveCalibration(radiometric=radiometric, bad_pixels=bad_pixels)
    from service.api.correction_tables.hdf5_file import read_table

    with _refusing_damage(f"{where} holds a calibration that is none"):
        found: dict[str, Any] = json.loads(document)
        calibration = _RESULT.validate_python(found["result"])
        content = {name: found[name] for name in found.keys() - _NOT_HASHED}
        own_hash = content_hash(content if len(content) > 1 else content["result"])
    if own_hash != found.get("content_hash"):
        raise InvalidRecording(
            f"{where} holds a calibration whose content has the hash {own_hash}; it says "
            f"{str(found.get('content_hash'))[:64]}: it was changed after it was written"
        )
    return ActiveCalibration(
        str(found.get("id")),
        calibration,
        None if found.get("table") is None else str(found["table"]),
        read_table(table).table if table else None,
        content,
        own_hash,
        table or None,
        radiometric,
        bad_pixels,
    )


def load_pixels(
    document: bytes, where: str
) -> tuple[ActiveRadiometric | None, tuple[LiveBadPixel, ...]]:
    """Return the radiometric calibration and the bad pixels of a document; None: it has none.

    Args:
        document: as of ``dump_active_calibration``.
        where: the recording's name, for errors.

    Raises:
        InvalidRecording: it is none, or was changed after it was written.
    """
    if not document:
        return None, ()
    with _refusing_damage(f"{where} holds a radiometric calibration, or bad pixels, that are none"):
        found = json.loads(document)
        if not isinstance(found, dict):
            raise TypeError("the document is no JSON object")
        bad_pixels = _BAD_PIXELS.validate_python(found.get("bad_pixels", ()))
        stored = found.get("radiometric")
        if stored is None:
            return None, bad_pixels
        content, kept = dict(stored["content"]), str(stored["content_hash"])
        sensors = content_of(content).sensors
        own_hash = content_hash(content)
    if own_hash != kept:
        raise InvalidRecording(
            f"{where} holds a radiometric calibration whose content has the hash {own_hash}; it "
            f"says {kept[:64]}: it was changed after it was written"
        )
    return ActiveRadiometric(str(stored.get("id")), sensors, own_hash, content), bad_pixels


@contextmanager
def _refusing_damage(what: str) -> Iterator[None]:
    """Raise InvalidRecording with ``what`` and the reason for whatever the content causes."""

    def invalid(reason: str) -> InvalidRecording:
        return InvalidRecording(f"{what}: {reason}")

    with refusing_damage(invalid):
        try:
            yield
        except ValidationError as error:
            raise invalid(error.errors()[0]["msg"]) from error
        except LumilineError as error:
            raise invalid(error.detail) from error
