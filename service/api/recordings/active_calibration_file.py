"""Active calibration in a recording: the calibration as JSON, its correction table as HDF5."""

import json
from datetime import UTC, datetime
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from compute.calibration.result import Calibration
from compute.errors import InvalidRecording
from service.api.calibrations.calibration_content import content_hash
from service.api.correction_tables.table_content import TableContent
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration

_RESULT: Final = TypeAdapter(Calibration)


def dump_active_calibration(found: ActiveCalibration) -> tuple[bytes, bytes]:
    """Return the calibration's document and the table's file; empty without them.

    The document has the members of the calibration's content (``result`` and, of one that the
    service stored, ``device``, ``provenance`` and ``points``), and ``id``, ``content_hash`` and
    ``table``, the table's id. `lumiline replay --calibration` takes it.
    """
    if found.calibration is None:
        return b"", b""
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
    }
    table = found.table_file
    if table is None and found.table is not None:
        # The file library is loaded by who needs it.
        from service.api.correction_tables.hdf5_file import write_table

        unknown = datetime.fromtimestamp(0, UTC)
        table = write_table(TableContent(found.table, "", unknown, {}, {}))
    return json.dumps(document, allow_nan=False).encode(), table or b""


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
    from service.api.correction_tables.hdf5_file import read_table

    try:
        found: dict[str, Any] = json.loads(document)
        calibration = _RESULT.validate_python(found["result"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        first = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise InvalidRecording(f"{where} holds a calibration that is none: {first}") from error
    content = {name: found[name] for name in found.keys() - {"id", "content_hash", "table"}}
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
    )
