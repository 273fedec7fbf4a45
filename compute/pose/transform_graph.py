"""TransformGraph: named coordinate frames and the transforms between them."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

from compute.errors import FrameConflict, InvalidParameter, UnknownFrame
from compute.pose.transform import Transform


@dataclass(frozen=True, eq=False)
class FrameLink:
    """A transform between two frames, as it was given.

    Args:
        to: the frame that coordinates are taken to.
        from_: the frame that they are of.
        transform: T_to_from.
        time_ns: when it was measured [ns]; None: it does not change with time.
    """

    to: str
    from_: str
    transform: Transform
    time_ns: int | None = None


@dataclass(frozen=True, eq=False)
class ResolvedTransform:
    """A transform along a path of links.

    Args:
        transform: T_to_from, its covariance propagated along the path.
        path: names of the frames from ``from_`` to ``to``, both included.
        oldest_ns: time of the oldest measured link; None: none of them changes with time.
        newest_ns: that of the newest.
    """

    transform: Transform
    path: tuple[str, ...]
    oldest_ns: int | None
    newest_ns: int | None


class TransformGraph:
    """Frames connected by transforms, each pair in one way only.

    Errors of the links are taken to be independent. Two poses of one tracker share the errors of
    its calibration, which largely cancel between tools that are near one another: the covariance
    of one relative to the other is rather too large.
    """

    def __init__(self, links: Iterable[FrameLink] = ()) -> None:
        """Make a graph of links; see ``connect`` for what is refused."""
        self._links: dict[tuple[str, str], FrameLink] = {}
        self._near: dict[str, list[str]] = {}
        for one in links:
            self.connect(one.to, one.from_, one.transform, one.time_ns)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames, in the order in which they came."""
        return tuple(self._near)

    @property
    def links(self) -> tuple[FrameLink, ...]:
        """Links as they were given."""
        return tuple(self._links.values())

    def connect(
        self, to: str, from_: str, transform: Transform, time_ns: int | None = None
    ) -> None:
        """Connect two frames by T_to_from.

        Raises:
            FrameConflict: they are connected already; a second way would have to agree with the
                first, and would not.
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
                    f'"{from_}" and "{to}" are connected already, by {_arrows(path)}; renew one '
                    "of these transforms, or take it out first",
                    path=list(path),
                )
        self._links[to, from_] = FrameLink(to, from_, transform, time_ns)
        self._near.setdefault(to, []).append(from_)
        self._near.setdefault(from_, []).append(to)

    def update(self, to: str, from_: str, transform: Transform, time_ns: int | None = None) -> None:
        """Put a newer T_to_from in the place of the one between these two frames.

        The link may have been given the other way round.

        Raises:
            UnknownFrame: no transform connects them directly.
        """
        key = self._key(to, from_)
        if key == (to, from_):
            self._links[key] = FrameLink(to, from_, transform, time_ns)
        else:
            self._links[key] = FrameLink(from_, to, transform.inverse(), time_ns)

    def disconnect(self, to: str, from_: str) -> None:
        """Take the transform between two frames out, and a frame that nothing connects any more.

        Raises:
            UnknownFrame: no transform connects them directly.
        """
        del self._links[self._key(to, from_)]
        for here, there in ((to, from_), (from_, to)):
            self._near[here].remove(there)
            if not self._near[here]:
                del self._near[here]

    def transform(self, to: str, from_: str) -> ResolvedTransform:
        """Return T_to_from along the way that connects the frames.

        Raises:
            UnknownFrame: there is no such frame, or no way between them.
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
        found = Transform.identity()
        times = []
        for here, there in pairwise(path):
            link = self._links[self._key(there, here)]
            step = link.transform if link.to == there else link.transform.inverse()
            found = step @ found
            if link.time_ns is not None:
                times.append(link.time_ns)
        return ResolvedTransform(found, path, min(times, default=None), max(times, default=None))

    def _key(self, to: str, from_: str) -> tuple[str, str]:
        self._check(to)
        self._check(from_)
        for key in ((to, from_), (from_, to)):
            if key in self._links:
                return key
        raise UnknownFrame(
            f'no transform connects "{from_}" and "{to}" directly; "{to}" has transforms to '
            f"{_listed(self._near[to])}",
            to=to,
            from_=from_,
        )

    def _check(self, name: str) -> None:
        if name not in self._near:
            raise UnknownFrame(
                f'there is no frame "{name}"; there are {_listed(self._near)}', frame=name
            )

    def _path(self, start: str, end: str) -> tuple[str, ...] | None:
        """Return the one way from frame to frame, both included."""
        came: dict[str, str | None] = {start: None}
        waiting = deque([start])
        while waiting:
            here = waiting.popleft()
            if here == end:
                path = [here]
                while (before := came[path[-1]]) is not None:
                    path.append(before)
                return tuple(reversed(path))
            for there in self._near[here]:
                if there not in came:
                    came[there] = here
                    waiting.append(there)
        return None

    def _reached(self, name: str) -> list[str]:
        return [one for one in self._near if one != name and self._path(name, one) is not None]


def _arrows(path: tuple[str, ...]) -> str:
    return " - ".join(f'"{one}"' for one in path)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f'"{one}"' for one in names) or "none"
