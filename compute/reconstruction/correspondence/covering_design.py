"""Covering design: sensor triples such that every visible marker has one."""

from functools import cache
from itertools import combinations


@cache
def covering_triples(sensors: int, seen: int) -> tuple[tuple[int, int, int], ...]:
    """Return triples such that every choice of ``seen`` of the sensors holds one of them.

    Greedy: each triple is the one that most of the choices left hold, the first in order of
    equals. For four sensors that all see, one triple is enough; for 4 of 8 it takes about twenty
    of the 56 (Turan's numbers are the least that there can be).

    Args:
        sensors: how many there are, at least ``seen``.
        seen: how many see a marker, at least 3.
    """
    triples = list(combinations(range(sensors), 3))
    open_choices = {frozenset(choice) for choice in combinations(range(sensors), seen)}
    taken = []
    while open_choices:
        best = max(
            triples, key=lambda triple: sum(choice.issuperset(triple) for choice in open_choices)
        )
        taken.append(best)
        open_choices = {choice for choice in open_choices if not choice.issuperset(best)}
    return tuple(taken)
