"""A case tells whoever listens, and nobody else."""

import pytest

from validation.progress import progress_listener, report_progress


def test_only_who_listens_is_told() -> None:
    told: list[tuple[float, str]] = []
    report_progress(0.1, "nobody listens")
    with progress_listener(lambda share, stage: told.append((share, stage))):
        report_progress(0.5, "half")
    report_progress(0.9, "no longer")
    assert told == [(0.5, "half")]


def test_what_the_listener_raises_ends_the_case() -> None:
    def stop(_share: float, _stage: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), progress_listener(stop):
        report_progress(0.5, "half")
    report_progress(0.6, "nobody listens any more")
