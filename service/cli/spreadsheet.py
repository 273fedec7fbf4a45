"""Reads a spreadsheet saved as text: its encoding, delimiter, header, empty cells and numbers."""

import csv
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from compute.errors import InvalidParameter

MISSING = frozenset(
    {"", "-", "\N{EN DASH}", "\N{EM DASH}", "n/a", "na", "#n/a", "#nv", "#n/d", "nan", "null"}
)
"""Cells without a value, in lower case; #NV and #N/D are what a German and a French Excel write."""

_BINARY = {b"PK\x03\x04": "an .xlsx or .ods file", b"\xd0\xcf\x11\xe0": "an .xls file"}
_DELIMITERS = "\t;,"
_GROUP_MARKS = (
    "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}'\N{RIGHT SINGLE QUOTATION MARK}"
)
_NUMBER = re.compile(rf"([+-]?)(\d[\d.,{_GROUP_MARKS}]*|[.,]\d+)(?:e([+-]?\d+))?", re.IGNORECASE)
_EITHER = re.compile(r"[1-9]\d{0,2}[.,]\d{3}")
"""1.234 is 1.234 or 1234."""


@dataclass(frozen=True)
class Cell:
    """Text of a cell, with its line in the file (from 1) and its column's heading."""

    text: str
    line: int
    heading: str

    @property
    def missing(self) -> bool:
        """Whether the cell states no value."""
        return self.text.lower() in MISSING

    @property
    def numeric(self) -> bool:
        """Whether the cell looks like a number, in whatever way it is written."""
        return _NUMBER.fullmatch(_plain(self.text)) is not None


@dataclass(frozen=True)
class Spreadsheet:
    """Columns and rows of a file.

    Args:
        path: the file.
        delimiter: between its cells.
        headings: of the columns.
        rows: cells of each row that has any text, as many as headings.
    """

    path: Path
    delimiter: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def read_spreadsheet(path: Path) -> Spreadsheet:
    """Read a file with commas, semicolons or tabs between cells, in UTF-8, UTF-16 or Windows-1252.

    Empty rows, lines that begin with # and Excel's first line ``sep=;`` are left out. A header may
    stand in the last comment before the numbers, as NumPy writes it.

    Raises:
        InvalidParameter: the file cannot be read, or a row has text below no heading.
    """
    lines = _decode(path).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    delimiter = None
    if re.fullmatch(r"sep=.", lines[0].strip(" "), re.IGNORECASE):
        delimiter, lines[0] = lines[0].strip(" ")[-1], ""
    start = next((at for at, line in enumerate(lines) if line.strip() and not _comment(line)), None)
    comments = [at for at, line in enumerate(lines[:start]) if _comment(line)]
    if start is not None and comments and _NUMBER.match(lines[start].strip(' "+-')):
        start = comments[-1]
        lines[start] = lines[start].lstrip(' #"')
    lines = ["" if at != start and _comment(line) else line for at, line in enumerate(lines)]
    if delimiter is None:
        header = "" if start is None else lines[start]
        delimiter = max(
            _DELIMITERS, key=lambda mark: len(next(csv.reader([header], delimiter=mark), ()))
        )
    try:
        reader = csv.reader((line + "\n" for line in lines), delimiter=delimiter)
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise InvalidParameter(f"{path} cannot be read as CSV: {error}") from error
    filled = [(line, row) for line, row in rows if any(row)]
    headings = tuple(filled[0][1]) if filled else ()
    return Spreadsheet(
        path,
        delimiter,
        headings,
        tuple(_row(path, line, row, headings) for line, row in filled[1:]),
    )


def _row(path: Path, line: int, row: list[str], headings: tuple[str, ...]) -> tuple[Cell, ...]:
    # The first column may have none: R and pandas write row numbers there.
    if any(row[len(headings) :]) or any(
        text and not name for text, name in zip(row[1:], headings[1:], strict=False)
    ):
        raise InvalidParameter(
            f"{path}, line {line} has text below no heading; quote cells with the delimiter in "
            "them, or save decimal commas with semicolons between the cells"
        )
    # Excel leaves out empty cells at the end of a row.
    texts = row + [""] * (len(headings) - len(row))
    return tuple(Cell(text, line, name) for text, name in zip(texts, headings, strict=False))


def _comment(line: str) -> bool:
    first = re.split(r'[\t;,"]', line.lstrip(' "'), maxsplit=1)[0]
    return first.startswith("#") and first.strip().lower() not in MISSING


def _decode(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror or error}") from error
    if data[:4] in _BINARY:
        raise InvalidParameter(
            f"{path} is {_BINARY[data[:4]]}; save the sheet as CSV (UTF-8) and give that file"
        )
    encodings = ["utf-8-sig", "cp1252"]
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = ["utf-16"]
    elif 0 in data[:2]:
        encodings = ["utf-16-le" if data[1] == 0 else "utf-16-be"]
    for encoding in encodings:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise InvalidParameter(f"{path} cannot be read as CSV: it is no text; save it as CSV (UTF-8)")


class NumberFormat:
    """Decimal mark and thousands separator of a file, found from all of its numbers.

    Args:
        sheet: the file.
        cells: all cells that must be numbers or empty.

    Raises:
        InvalidParameter: the file mixes decimal points and commas, or they can be thousands
            separators.
    """

    def __init__(self, sheet: Spreadsheet, cells: Iterable[Cell]) -> None:
        self._path = sheet.path
        evidence: dict[str, Cell] = {}
        unclear: dict[str, Cell] = {}
        self._grouped = False
        for cell in cells:
            match = _NUMBER.fullmatch(_plain(cell.text))
            marks = re.sub("[^.,]", "", match[2]) if match else ""
            if not match or not marks:
                continue
            if len(marks) > 1:
                self._grouped = True
                mark = marks[-1] if marks[-1] != marks[0] else _other(marks[0])
                evidence.setdefault(mark, cell)
            elif _EITHER.fullmatch(match[2]) and match[3] is None:
                unclear.setdefault(marks, cell)
            else:
                evidence.setdefault(marks, cell)
        if len(evidence) > 1:
            point, comma = evidence["."], evidence[","]
            raise InvalidParameter(
                f'{sheet.path} has decimal points (line {point.line}: "{point.text}") and decimal '
                f'commas (line {comma.line}: "{comma.text}"); write all numbers in one way'
            )
        # Programs delimit by semicolons where the comma is the decimal mark.
        usual = {",": ".", ";": ","}.get(sheet.delimiter, "")
        self._decimal = next(
            iter(evidence), usual if len(unclear) == 1 and usual in unclear else ""
        )
        for mark, cell in unclear.items():
            if mark != self._decimal and not (evidence and self._grouped):
                raise InvalidParameter(
                    f"{self._where(cell)}, and it is not clear whether this is a decimal mark or a "
                    "thousands separator; save the numbers without thousands separators and with "
                    "four decimals"
                )
        self._decimal = self._decimal or "."

    def number(self, cell: Cell, power: int = 0) -> float:
        """Return the number in a cell times ``10**power``, rounded once; NaN where it is missing.

        Raises:
            InvalidParameter: the cell is no number.
        """
        if cell.missing:
            return float("nan")
        match = _NUMBER.fullmatch(_plain(cell.text))
        integer, _, fraction = match[2].partition(self._decimal) if match else ("", "", "")
        groups = re.split(f"[.,{_GROUP_MARKS}]", integer)
        marks = set(re.sub(r"\d", "", integer))
        grouped = len(groups) == 1 or (
            len(marks) == 1
            and 1 <= len(groups[0]) <= 3
            and all(len(one) == 3 for one in groups[1:])
        )
        if match is None or not grouped or not re.fullmatch(r"\d*", fraction):
            raise InvalidParameter(f"{self._where(cell)}; it must be a number")
        return float(f"{match[1]}{''.join(groups)}.{fraction}e{int(match[3] or 0) + power}")

    def _where(self, cell: Cell) -> str:
        return f'{self._path}, line {cell.line}: {cell.heading} is "{cell.text}"'


def _plain(text: str) -> str:
    return text.replace("\N{MINUS SIGN}", "-")


def _other(mark: str) -> str:
    return "," if mark == "." else "."
