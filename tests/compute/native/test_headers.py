"""The kernels' headers: how they are combined, and the records that Python and C++ share."""

import pytest

from compute.native.headers import combined_source, header_text
from compute.native.records import Record, constants
from tests.compute.native.host import compiler, headers, run, write_generated

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C++ compiler (c++, g++)")


def test_every_header_is_included_once() -> None:
    source = combined_source("compute/pose/filtering/native/strobed_step.h")
    assert source.count('#line 1 "compute/native/platform.h"') == 1
    assert source.count("struct CameraRecord {") == 1
    assert "#include" not in source.replace("#include <math.h>", "")
    assert "#pragma once" not in source


def test_source_without_line_directives_is_the_same_otherwise() -> None:
    path = "compute/signal/native/find_peaks.h"
    lines = [line for line in combined_source(path).splitlines() if not line.startswith("#line")]
    assert combined_source(path, line_directives=False).splitlines() == lines


def test_missing_header_is_an_error() -> None:
    with pytest.raises(FileNotFoundError):
        header_text("compute/native/nothing.h")


def test_record_has_the_layout_of_its_fields() -> None:
    inner = Record("Inner", {"flag": "int", "value": "double"})
    outer = Record("Outer", {"at": "const double*", "rows": "float[2][3]", "inner": inner})
    assert inner.dtype.itemsize == 16
    assert outer.dtype["rows"].shape == (2, 3)
    assert outer.dtype.fields is not None
    assert [outer.dtype.fields[name][1] for name in ("at", "rows", "inner")] == [0, 8, 32]
    assert "const double* at;" in outer.source
    assert "float rows[2][3];" in outer.source


def test_constants_keep_every_digit() -> None:
    assert constants({"third": 1 / 3, "count": 7, "wide": 2.0}) == (
        "constexpr double third = 0.3333333333333333;\n"
        "constexpr int count = 7;\n"
        "constexpr double wide = 2.0;\n"
    )


@needs_compiler
def test_record_has_the_same_offsets_in_c(tmp_path) -> None:
    inner = Record("Inner", {"flag": "int", "value": "double"})
    record = Record("Outer", {"byte": "int", "many": "float[3]", "inner": inner, "last": "int"})
    fields = record.dtype.fields
    assert fields is not None
    checks = "".join(
        f'static_assert(__builtin_offsetof(Outer, {name}) == {place[1]}, "{name}");\n'
        for name, place in fields.items()
    )
    (tmp_path / "record.cpp").write_text(inner.source + record.source + checks)
    assert run(tmp_path, "-fsyntax-only", str(tmp_path / "record.cpp")) == ""


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("header", headers())
def test_header_compiles_alone_without_warnings(header: str, tmp_path) -> None:
    write_generated(tmp_path)
    (tmp_path / "alone.cpp").write_text(f'#include "{header}"\n')
    assert run(tmp_path, "-fsyntax-only", str(tmp_path / "alone.cpp")) == ""


def test_generated_header_says_what_python_says() -> None:
    from compute.reconstruction.triangulation import MAX_ITERATIONS

    text = header_text("compute/reconstruction/native/definitions.gen.h")
    assert f"constexpr int max_iterations = {MAX_ITERATIONS};" in text
