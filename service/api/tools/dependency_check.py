"""Checks at the end of a measurement that the tools and frames it names are unchanged."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

from sqlalchemy.orm import Session

from service.api.tools.store import TOOLS, get_same_tool
from service.database.models import RegistrationRow
from service.problems.errors import RegistrationReplaced


@dataclass(frozen=True)
class Dependencies:
    """Tools and registrations, and when each was created: a name may be given to another one.

    Args:
        tools: by id.
        registrations: by id.
    """

    tools: dict[str, datetime] = field(default_factory=dict)
    registrations: dict[str, datetime] = field(default_factory=dict)

    def check(self, session: Session) -> None:
        """Check that all are the same still.

        Raises:
            UnknownTool: a tool was deleted.
            ToolReplaced: it was, and created again.
            RegistrationReplaced: a registration was deleted, and perhaps made again.
        """
        for name, created_at in self.tools.items():
            get_same_tool(session, name, created_at)
        for name, created_at in self.registrations.items():
            row = session.get(RegistrationRow, name)
            if row is None or row.created_at != created_at:
                how = "deleted" if row is None else "deleted and made again"
                raise RegistrationReplaced(
                    f'registration "{name}" was {how} while it was used; what was found is of the '
                    "former one and was not kept; do it again",
                    registration_id=name,
                )


def dependencies(
    session: Session,
    tools: Sequence[str | None] = (),
    registrations: Sequence[RegistrationRow] = (),
) -> Dependencies:
    """Return tools, None for none, and registrations as they are now; raises UnknownTool."""
    names = dict.fromkeys(name for name in tools if name is not None)
    return Dependencies(
        {name: TOOLS.get(session, name).created_at for name in names},
        {row.id: row.created_at for row in registrations},
    )
