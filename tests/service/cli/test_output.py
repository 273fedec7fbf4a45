"""What is printed is what was said; files are whole, and overwritten only where that is asked."""

from pathlib import Path

import pytest
import typer

from service.cli.output import (
    atomic_file,
    check_output,
    console,
    fail,
    make_table,
    say,
    say_written,
)


def test_brackets_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    assert fail("pip install 'lumiline[export]'").exit_code == 2
    assert capsys.readouterr().err == "error: pip install 'lumiline[export]'\n"


def test_check_output_file_exists_refused_without_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "there"
    there.touch()
    check_output(there, force=True)
    check_output(tmp_path / "new", force=False)
    check_output(None, force=False)
    check_output(Path("/dev/null"), force=False)
    for path, message in (
        (there, "--force"),
        (tmp_path, "it is a folder"),
        (tmp_path / "no" / "file", "there is no folder"),
    ):
        with pytest.raises(typer.Exit):
            check_output(path, force=False)
        assert message in " ".join(capsys.readouterr().err.split())


def _write_half(path: Path) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text("part", encoding="utf-8")
        raise ValueError("half way")


def test_atomic_file_failure_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    for before in (None, "old"):
        if before is not None:
            path.write_text(before, encoding="utf-8")
        with pytest.raises(ValueError, match="half"):
            _write_half(path)
        assert [one.name for one in tmp_path.iterdir()] == ([] if before is None else [path.name])
    assert path.read_text(encoding="utf-8") == "old"
    with atomic_file(path) as temporary:
        assert temporary.name == path.name
        temporary.write_text("new", encoding="utf-8")
    assert path.read_text(encoding="utf-8") == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_atomic_file_link_its_target_is_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old", encoding="utf-8")
    link.symlink_to(target)
    with atomic_file(link) as temporary:
        temporary.write_text("new", encoding="utf-8")
    assert link.is_symlink()
    assert target.read_text(encoding="utf-8") == "new"


def test_ids_and_paths_are_never_broken_over_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_width", 40)
    identity = "radiometric-calibration-2026-11-24T10-00-00Z-of-the-left-bar"
    console.print(make_table(("id", "note"), [(identity, "a note of several words")], texts=None))
    say(f"stored as {identity}; activate it")
    say_written(Path(f"/tmp/{identity}/{identity}.json"))
    fail(f"there is no calibration {identity}")
    captured = capsys.readouterr()
    assert captured.out.count(identity) == 4
    assert identity in captured.err


def test_table_that_fits_keeps_the_terminals_width(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_width", 40)
    console.print(make_table(("id", "note"), [("left", "word " * 20)], texts=None))
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 40
