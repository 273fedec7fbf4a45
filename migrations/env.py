"""Runs the revisions on the connection that service.database.migration hands over."""

from alembic import context

from service.database.models import Base


def run() -> None:
    """Run the revisions; a connection is always given, there is no offline mode."""
    connection = context.config.attributes.get("connection")
    if connection is None:
        raise RuntimeError("run the migrations by service.database.migration.migrate()")
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        compare_type=True,
        render_as_batch=connection.dialect.name == "sqlite",
    )
    with context.begin_transaction():
        context.run_migrations()


run()
