"""Cases whose result is tables: published figures and ours in neighbouring columns."""

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature
from pathlib import Path

Cell = str | float | None

OPTIONS = ("seed", "trials")
"""Options of random cases."""


@dataclass(frozen=True)
class ResultTable:
    """One table.

    Args:
        title: what it shows, with the units.
        headings: of its columns.
        rows: as many cells as there are headings; None: nothing is known.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"{len(row)} cells under {len(self.headings)} headings: {row}")

    def column(self, heading: str) -> tuple[Cell, ...]:
        """Return the cells of one column."""
        index = self.headings.index(heading)
        return tuple(row[index] for row in self.rows)


@dataclass(frozen=True)
class TablesResult:
    """A case that was run: its tables, and what they show.

    Args:
        name: the case's name.
        title: the case's title.
        source: where the published figures stand.
        tables: the tables.
        findings: what the tables show and what was assumed, a sentence or two each.
    """

    name: str
    title: str
    source: str
    tables: tuple[ResultTable, ...]
    findings: tuple[str, ...]

    def table(self, title_start: str) -> ResultTable:
        """Return the table whose title starts so."""
        return next(table for table in self.tables if table.title.startswith(title_start))


@dataclass(frozen=True)
class TablesCase:
    """A published table, or a question, that can be worked out again.

    Args:
        name: name on the command line.
        title: what it is.
        source: where the published figures stand.
        compute_tables: returns the tables and the findings; with a ``seed`` or ``trials`` as
            parameters where it draws random numbers.
        picture: draws it as a PNG; None: there is nothing to draw.
    """

    name: str
    title: str
    source: str
    compute_tables: Callable[..., tuple[tuple[ResultTable, ...], tuple[str, ...]]]
    picture: Callable[[Path], None] | None = None

    @property
    def options(self) -> tuple[str, ...]:
        """Names of what may be given to ``run``: "seed", "trials", both or neither."""
        return tuple(name for name in OPTIONS if name in signature(self.compute_tables).parameters)

    def run(self, **options: int) -> TablesResult:
        """Compute the tables.

        Args:
            options: some of ``options``; the case's own values stand for those left out.
        """
        tables, findings = self.compute_tables(**options)
        return TablesResult(self.name, self.title, self.source, tables, findings)
