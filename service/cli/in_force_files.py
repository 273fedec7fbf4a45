"""What is to be reconstructed with, from files: a calibration, and its correction table."""

from pathlib import Path

from compute.errors import InvalidParameter
from service.cli.calibration_file import read_calibration
from service.live.in_force import InForce


def read_in_force(calibration: Path | None, table: Path | None) -> InForce | None:
    """Return the calibration and table of these files; None: none are given."""
    from service.correction_tables.hdf5 import read_table

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
    return InForce(
        str(calibration), known.calibration, None if table is None else str(table), corrections
    )
