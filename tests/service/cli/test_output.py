"""What is printed is what was said; files are whole, and overwritten only where that is asked."""

from pathlib import Path

import pytest
import typer

from service.cli.output import atomic_file, check_output, fail


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
