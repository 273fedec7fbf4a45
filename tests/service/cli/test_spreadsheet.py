"""Spreadsheets as programs write them: read to the last digit, or refused with what to do."""

import csv
import io
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from compute.errors import InvalidParameter
from service.cli.observations_csv import read_observations, read_wand

POINTS = 12
NNBSP, NBSP = "\N{NARROW NO-BREAK SPACE}", "\N{NO-BREAK SPACE}"
PLAIN = ("X_mm", "Y_mm", "Z_mm", "left_px", "right_px")


@dataclass(frozen=True)
class Style:
    """How a program of a language writes a spreadsheet as text."""

    headings: tuple[str, ...] = PLAIN
    delimiter: str = ","
    decimal: str = "."
    group: str = ""
    encoding: str = "utf-8"
    missing: str = ""
    newline: str = "\n"
    quoting: Literal[0, 1, 2, 3] = csv.QUOTE_MINIMAL
    power: int = 0
    decimals: int = 6
    row_names: str | None = None
    before: str = ""
    after: str = ""
    unclear: str = ""

    def number(self, value: Decimal, power: int = 0) -> str:
        text = f"{value.scaleb(-power):{',' if self.group else ''}f}"
        return text.translate({ord(","): self.group or ",", ord("."): self.decimal})


ENGLISH = Style(newline="\r\n")
GERMAN = replace(ENGLISH, delimiter=";", decimal=",")
FRENCH = replace(GERMAN)
R = Style(missing="NA", quoting=csv.QUOTE_NONNUMERIC, row_names="")
MATLAB = Style(missing="NaN")
BRACKETS = ("X [mm]", "Y [mm]", "Z [mm]", "left [px]", "right [px]")


def headings(unit: str) -> tuple[str, ...]:
    return (f"X [{unit}]", f"Y [{unit}]", f"Z [{unit}]", "left [px]", "right [px]")


STYLES = {
    "excel-en-csv": replace(ENGLISH, encoding="cp1252"),
    "excel-en-utf8": replace(ENGLISH, encoding="utf-8-sig"),
    "excel-en-unicode-text": replace(ENGLISH, encoding="utf-16", delimiter="\t"),
    "excel-en-thousands": replace(ENGLISH, group=","),
    "excel-en-na": replace(ENGLISH, missing="#N/A"),
    "excel-de-csv": replace(GERMAN, encoding="cp1252"),
    "excel-de-utf8": replace(GERMAN, encoding="utf-8-sig"),
    "excel-de-unicode-text": replace(GERMAN, encoding="utf-16", delimiter="\t"),
    "excel-de-thousands": replace(GERMAN, group="."),
    "excel-de-nv": replace(GERMAN, missing="#NV"),
    "excel-de-sep-line": replace(GERMAN, before="sep=;\r\n"),
    "excel-de-micrometres": replace(GERMAN, encoding="cp1252", headings=headings("µm"), power=-3),
    "excel-fr-csv": replace(FRENCH, encoding="cp1252"),
    "excel-fr-thousands": replace(FRENCH, encoding="cp1252", group=NBSP),
    "excel-fr-nd": replace(FRENCH, encoding="utf-8-sig", missing="#N/D"),
    "excel-ch-thousands": replace(GERMAN, decimal=".", group="'"),
    "libreoffice-en": Style(),
    "libreoffice-en-quoted": Style(quoting=csv.QUOTE_ALL),
    "libreoffice-en-empty-lines": Style(after=",,,,,\n\n,,,,,\n"),
    "libreoffice-de": replace(GERMAN, newline="\n"),
    "libreoffice-de-commas": Style(decimal=",", quoting=csv.QUOTE_ALL),
    "libreoffice-de-tabs": replace(GERMAN, newline="\n", delimiter="\t"),
    "libreoffice-fr": replace(FRENCH, newline="\n", group=NNBSP),
    "libreoffice-fr-utf16": replace(FRENCH, newline="\n", encoding="utf-16-le"),
    "libreoffice-slash": replace(GERMAN, headings=("x/mm", "y/mm", "z/mm", "left/px", "right/px")),
    "pandas": Style(row_names=""),
    "pandas-no-index": Style(headings=BRACKETS),
    "pandas-semicolons": Style(delimiter=";", decimal=",", missing="n/a"),
    "pandas-three-decimals": Style(decimals=3),
    "pandas-metres": Style(headings=headings("m"), power=3),
    "pandas-centimetres": Style(headings=headings("cm"), power=1),
    "numpy-savetxt": Style(missing="nan", before="# "),
    "numpy-comment": Style(before="# waved on Monday, by hand\n\n"),
    "r-write-csv": R,
    "r-write-csv2": replace(R, delimiter=";", decimal=","),
    "r-mangled": replace(R, headings=("X..mm.", "Y..mm.", "Z..mm.", "left..px.", "right..px.")),
    "matlab-writetable": replace(MATLAB, headings=tuple(f"{name}_" for name in PLAIN)),
    "matlab-preserved": replace(MATLAB, headings=BRACKETS, missing="-"),
    "matlab-de": replace(MATLAB, delimiter=";", decimal=","),
    "matlab-tabs": replace(MATLAB, delimiter="\t", encoding="utf-8-sig"),
    # What is unclear is asked back.
    "tabs-three-decimals": Style(delimiter="\t", decimals=3, unclear="four decimals"),
    "semicolons-three-decimals": Style(delimiter=";", decimals=3, unclear="four decimals"),
    "decimal-commas-unquoted": Style(decimal=",", quoting=csv.QUOTE_NONE, unclear="semicolons"),
    "no-unit": Style(headings=("X", "Y", "Z", "left_px", "right_px"), unclear="no column X_mm"),
    "inches": Style(headings=headings("in"), unclear="may be in m, cm, mm or um"),
    "spaces": Style(delimiter=" ", unclear="separated by commas, semicolons or tabs"),
    "excel-error": replace(ENGLISH, missing="#DIV/0!", unclear="line 3: right_px is .#DIV/0!"),
}  # fmt: skip


def generate(style: Style) -> tuple[bytes, np.ndarray]:
    """Return a file, and its numbers in mm and px; one reading is missing."""
    rng = np.random.default_rng(7)
    scale = 10**style.decimals
    # Above 1 and below 1000 with three decimals, so that each number can be one with thousands.
    low, high = (1, 999) if style.decimals == 3 else (-4000, 4000)
    whole = rng.integers(low * scale, high * scale, (POINTS, 5))
    values = [[Decimal(int(v)).scaleb(-style.decimals) for v in row] for row in whole]
    buffer = io.StringIO(newline="")
    writer = csv.writer(
        buffer, delimiter=style.delimiter, lineterminator=style.newline, quoting=style.quoting,
        escapechar="\\",
    )  # fmt: skip
    extra = [] if style.row_names is None else [style.row_names]
    writer.writerow([*extra, *style.headings])
    if style.quoting == csv.QUOTE_NONNUMERIC:  # R quotes texts only.
        writer = csv.writer(buffer, delimiter=style.delimiter, lineterminator=style.newline)
    for number, row in enumerate(values):
        cells = [style.number(v, style.power if at < 3 else 0) for at, v in enumerate(row)]
        if number == 1:
            cells[4] = style.missing
        writer.writerow([*(str(number + 1) for _ in extra), *cells])
    expected = np.array([[float(str(v)) for v in row] for row in values])
    expected[1, 4] = np.nan
    text = buffer.getvalue().replace("\\,", ",")
    return f"{style.before}{text}{style.after}".encode(style.encoding), expected


@pytest.mark.parametrize("name", STYLES)
def test_read_observations_spreadsheet_equal_or_asked_back(tmp_path: Path, name: str) -> None:
    style = STYLES[name]
    path = tmp_path / f"{name}.csv"
    content, expected = generate(style)
    path.write_bytes(content)
    if style.unclear:
        with pytest.raises(InvalidParameter, match=style.unclear) as raised:
            read_observations(path)
        assert "\n" not in str(raised.value)
        return
    table = read_observations(path)
    assert table.sensors == ("left", "right")
    np.testing.assert_array_equal(np.c_[table.points_mm, table.readings_px], expected)


def test_styles_count_is_that_of_the_documentation() -> None:
    assert sum(not style.unclear for style in STYLES.values()) == 40


HEADER = "name,X_mm,Y_mm,Z_mm,left_px\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "a,1.5,2,3,4\n" + 'b,"1,5",2,3,4\n', "points .line 2: .1.5.. and decimal"),
        (HEADER + 'a,"1.234,50",2,3,"4,7"\nb,"12.34,5",2,3,4\n', "line 3: X_mm is .12.34,5.; it"),
        (HEADER + "a,1.5,2,3,480 512\n", "left_px is .480 512.; it must be a number"),
        (HEADER + "a,1.5,2,3,inf\n", "left_px is .inf.; it must be a number"),
        (HEADER + 'a,1.5,2,3,"1,234"\n', "thousands separator"),
        (HEADER + "# a comment\n\na,1.5,-,3,4\n", "line 4: Y_mm is .-.; it must be a number"),
        ("X_mm,Y_mm,Z_mm,left_px,,,\n1,5,2,3,4\n", "line 2 has text below no heading"),
        ("PK\x03\x04rest", "an .xlsx or .ods file; save the sheet as CSV"),
        ("\0\0\0\0", "it is no text"),
    ],
)  # fmt: skip
def test_read_observations_unclear_cell_refused_with_its_place(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidParameter, match=message):
        read_observations(path)


def test_read_observations_name_column_labels_the_points(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(
        "Name;x [mm];y [mm];z [mm];left [px]\nKugel ä;1,5;2;3;4\n;5;6;7;\u22128\n", "cp1252",
        errors="replace",
    )  # fmt: skip
    with pytest.raises(InvalidParameter, match=r"left .px. is"):
        read_observations(path)
    path.write_text("Name;x [mm];y [mm];z [mm];left [px]\nKugel ä;1,5;2;3;4\n;5;6;7;8\n", "cp1252")
    table = read_observations(path)
    assert table.labels == ("Kugel ä", "2")
    assert table.points_mm.tolist() == [[1.5, 2.0, 3.0], [5.0, 6.0, 7.0]]


def test_read_wand_semicolons_and_commas_read(tmp_path: Path) -> None:
    path = tmp_path / "wand.csv"
    path.write_text("Pose;Marker;left [px]\nfirst;1;12,5\nfirst;2;13,25\nnext;2;n/a\n")
    table = read_wand(path, 2)
    np.testing.assert_array_equal(table.readings_px[..., 0], [[12.5, 13.25], [np.nan, np.nan]])
