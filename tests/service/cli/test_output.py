"""What is printed is what was said."""

import pytest

from service.cli.output import fail


def test_brackets_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    assert fail("pip install 'lumiline[export]'").exit_code == 2
    assert capsys.readouterr().err == "error: pip install 'lumiline[export]'\n"
