"""A real server for the tests of these folders."""

from collections.abc import Iterator

import pytest

from tests.running_server import serving


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Base URL of a running service."""
    with serving(tmp_path_factory.mktemp("server")) as url:
        yield url
