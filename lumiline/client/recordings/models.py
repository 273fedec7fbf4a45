"""What the server answers about recordings, their exports, and runs."""

from datetime import datetime

from lumiline.client.response_model import ResponseModel


class Recording(ResponseModel):
    """A recording in the server's folder."""

    name: str
    device: str | None
    state: str
    reason: str | None
    contents: tuple[str, ...]
    frames: int | None
    duration_s: float | None
    size_bytes: int
    started_at: datetime | None


class Export(ResponseModel):
    """A file that an export run has made."""

    id: str
    format: str
    file_name: str
    media_type: str
    size_bytes: int
    created_at: datetime
    run: str | None
    device: str | None
    recording: str | None


class RunProblem(ResponseModel):
    """Why a run failed."""

    type: str
    title: str
    status: int
    detail: str


class Run(ResponseModel):
    """A computation beside the requests: ``state`` ``queued`` or ``running`` is not its last."""

    id: str
    kind: str
    device: str
    state: str
    progress: float
    stage: str
    result_id: str | None
    result: str | None
    problem: RunProblem | None

    @property
    def ended(self) -> bool:
        """Whether it changes no more."""
        return self.state not in ("queued", "running")
