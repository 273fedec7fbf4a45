"""TransformGraph: named coordinate frames and the transforms between them."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

from compute.errors import FrameConflict, InvalidParameter, UnknownFrame
from compute.transform import Transform


@dataclass(frozen=True, eq=False)
class ResolvedTransform:
    """A transform along a path of frames.

    Args:
        transform: T_to_from, its covariance propagated along the path.
        path: names of the frames from ``from_`` to ``to``, both included.
    """

    transform: Transform
    path: tuple[str, ...]


class TransformGraph:
    """Frames connected by transforms, without loops.

    Errors of the transforms are treated as independent. Two poses of one tracker share the errors
    of its calibration, which largely cancel between tools that are close together: the covariance
    of one relative to the other is then too large.
    """

    def __init__(self) -> None:
        """Make an empty graph."""
        self._transforms: dict[tuple[str, str], Transform] = {}
        self._near: dict[str, list[str]] = {}

    def connect(self, to: str, from_: str, transform: Transform) -> None:
        """Connect two frames by T_to_from.

        Args:
            to: name of the frame that coordinates are transformed to.
            from_: name of the frame that they are transformed from.
            transform: T_to_from.

        Raises:
            FrameConflict: they are connected already; a second path could contradict the first.
            InvalidParameter: a name is empty, or both are the same.
        """
        if not to or not from_:
            raise InvalidParameter(f'frames are named "{to}" and "{from_}"; a name cannot be empty')
        if to == from_:
            raise InvalidParameter(f'a transform from "{to}" to itself says nothing')
        if to in self._near and from_ in self._near:
            path = self._path(from_, to)
            if path is not None:
                raise FrameConflict(
                    f'"{from_}" and "{to}" are connected already, by {_arrows(path)}; leave out '
                    "one of these transforms",
                    path=list(path),
                )
        self._transforms[to, from_] = transform
        self._near.setdefault(to, []).append(from_)
        self._near.setdefault(from_, []).append(to)

    def transform(self, to: str, from_: str) -> ResolvedTransform:
        """Return T_to_from along the path that connects the frames.

        Args:
            to: name of the frame that coordinates are transformed to.
            from_: name of the frame that they are transformed from.

        Raises:
            UnknownFrame: there is no such frame, or no path between them.
        """
        self._check(to)
        self._check(from_)
        path = self._path(from_, to)
        if path is None:
            raise UnknownFrame(
                f'nothing connects "{from_}" with "{to}": "{from_}" is connected with '
                f'{_listed(self._reached(from_))}, "{to}" with {_listed(self._reached(to))}',
                to=to,
                from_=from_,
            )
        chain = Transform.identity()
        for here, there in pairwise(path):
            step = self._transforms.get((there, here))
            chain = (self._transforms[here, there].inverse() if step is None else step) @ chain
        return ResolvedTransform(chain, path)

    def _check(self, name: str) -> None:
        if name not in self._near:
            raise UnknownFrame(
                f'there is no frame "{name}"; there are {_listed(self._near)}', frame=name
            )

    def _path(self, start: str, end: str) -> tuple[str, ...] | None:
        """Return the path between two frames, both included; None: there is none."""
        # There are no loops: no frame is reached in two ways.
        paths: list[tuple[str, ...]] = [(start,)]
        for path in paths:
            if path[-1] == end:
                return path
            paths += [(*path, near) for near in self._near[path[-1]] if near not in path]
        return None

    def _reached(self, name: str) -> list[str]:
        return [one for one in self._near if one != name and self._path(name, one) is not None]


def _arrows(path: tuple[str, ...]) -> str:
    return " - ".join(f'"{one}"' for one in path)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f'"{one}"' for one in names) or "none"
