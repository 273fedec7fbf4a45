"""Search models of peaks as plain values, and back: nothing that a machine sends is code."""

from dataclasses import fields, is_dataclass
from typing import Any, Final

import numpy as np

from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise
from service.pipeline.detection_stage import SearchModel

_KINDS: Final[dict[str, type[Any]]] = {
    kind.__name__: kind
    for kind in (
        SearchModel,
        SensorNoise,
        CentroidSettings,
        FitSettings,
        LineSpreadFunction,
        PixelCorrections,
    )
}
_ARRAY: Final = "array"
_TUPLE: Final = "tuple"


def plain_search_model(model: SearchModel) -> Any:
    """Return a search model as plain values."""
    return _plain(model)


def read_search_model(value: Any) -> SearchModel:
    """Return a search model from its plain values.

    Raises:
        ValueError: they are those of none.
    """
    model = _read(value)
    if not isinstance(model, SearchModel):
        raise ValueError(f"a station has sent {type(model).__name__} as a search model")
    return model


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_ARRAY, value.dtype.str, list(value.shape), value.tobytes()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return [_TUPLE, [_plain(one) for one in value]]
    if is_dataclass(value):
        members = {one.name: _plain(getattr(value, one.name)) for one in fields(value) if one.init}
        return [type(value).__name__, members]
    return value


def _read(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    kind, *rest = value
    if kind == _ARRAY:
        dtype, shape, data = rest
        return np.frombuffer(data, np.dtype(dtype)).reshape(shape)
    if kind == _TUPLE:
        return tuple(_read(one) for one in rest[0])
    if kind not in _KINDS:
        raise ValueError(f"{kind!r} is no part of a search model")
    return _KINDS[kind](**{name: _read(one) for name, one in rest[0].items()})
