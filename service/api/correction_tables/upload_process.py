"""Reads an uploaded table in a separate process with limits of time and memory."""

from pathlib import Path
from typing import Any, Final

from service.api.concurrency_limit import ConcurrencyLimit
from service.api.correction_tables.table_content import (
    SIGNATURE_BYTES,
    TableContent,
    check_signature,
    check_table,
)
from service.jobs.worker_process import call_in_process
from service.problems.errors import InvalidTableFile, WorkerEnded

MAX_CONCURRENT: Final = 2
TIMEOUT_S: Final = 60.0
MEMORY_BYTES: Final = 2 * 1024**3

_limit = ConcurrencyLimit(
    MAX_CONCURRENT,
    f"{MAX_CONCURRENT} uploads are being read; send this one again in a few seconds",
)


def read_in_process(path: Path) -> TableContent:
    """Return what an uploaded file holds; only the process loads it.

    Raises:
        Busy: as many uploads as may are being read.
        InvalidTableFile: as ``read_table``; also when reading crashes or takes too much.
        InvalidParameter, NonFiniteValue, NoValidCells: as ``read_table`` and ``check_table``.
    """
    with path.open("rb") as file:
        check_signature(file.read(SIGNATURE_BYTES))
    try:
        with _limit:
            found: TableContent = call_in_process(
                _read, path, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES
            )
    except WorkerEnded as error:
        raise InvalidTableFile(
            f"the file could not be read within {TIMEOUT_S:g} s and {MEMORY_BYTES} bytes of "
            f"memory: {error.detail}"
        ) from error
    return found


def _read(_tell: Any, path: Path) -> TableContent:
    from service.api.correction_tables.hdf5_file import read_table

    content = read_table(path.read_bytes())
    check_table(content.table)
    return content
