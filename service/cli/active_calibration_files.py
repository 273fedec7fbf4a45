"""Calibration and correction table from files, as the active calibration of an offline command."""

from pathlib import Path

from compute.errors import InvalidParameter
from service.cli.calibration_file import read_calibration
from service.pipeline.active_calibration import ActiveCalibration


def read_active_calibration(
    calibration: Path | None, table: Path | None
) -> ActiveCalibration | None:
    """Return the calibration and table of these files; None: none are given."""
    from service.api.correction_tables.hdf5_file import read_table

    if calibration is None:
        if table is not None:
            raise InvalidParameter(
                "--table needs the table's calibration: give it with --calibration"
            )
        return None
    known = read_calibration(calibration)
    corrections = None if table is None else read_table(table.read_bytes()).table
    if corrections is not None and corrections.calibration_hash != known.content_hash:
        raise InvalidParameter(
            f"the table {table} was made for the calibration with the hash "
            f"{corrections.calibration_hash}; {calibration} has {known.content_hash}"
        )
    return ActiveCalibration(
        str(calibration), known.calibration, None if table is None else str(table), corrections
    )
