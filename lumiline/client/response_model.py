"""ResponseModel: the base of what the server answers, and the types of its numbers."""

from pydantic import BaseModel, ConfigDict

Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Row6 = tuple[float, float, float, float, float, float]
Matrix4 = tuple[tuple[float, float, float, float], ...]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]


class ResponseModel(BaseModel):
    """Base of what the server answers."""

    model_config = ConfigDict(frozen=True, extra="allow")
