"""SHA-256 of a backup, as the last bytes of its file: SQLite has no checksum of its own."""

import hashlib
import shutil
from pathlib import Path
from typing import Final

from service.problems.errors import BackupUnusable

_MARK: Final = b"\nlumiline-backup sha256 "
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
CHECKSUM_BYTES: Final = len(_MARK) + _DIGEST_BYTES


def add_checksum(file: Path) -> None:
    """Append the checksum to a SQLite file, which stays one: its header says where it ends."""
    with file.open("r+b") as opened:
        digest = hashlib.file_digest(opened, "sha256").digest()
        opened.write(_MARK + digest)


def copy_checked(file: Path, copy: Path) -> None:
    """Copy a backup without its checksum, after comparing it.

    Raises:
        BackupUnusable: the file ends with no checksum, or with that of another content.
    """
    shutil.copyfile(file, copy)
    with copy.open("r+b") as opened:
        end = opened.seek(0, 2) - CHECKSUM_BYTES
        opened.seek(max(0, end))
        stored = opened.read()
        if end < 0 or not stored.startswith(_MARK):
            raise BackupUnusable(
                f"{file} is no backup of this service, or is cut short: it does not end with its "
                "checksum; give a file that `lumiline backup` wrote"
            )
        opened.truncate(end)
        opened.seek(0)
        if hashlib.file_digest(opened, "sha256").digest() != stored[len(_MARK) :]:
            raise BackupUnusable(
                f"{file} is damaged: its content is not what its checksum was made of; take "
                "another backup"
            )
