"""What endpoints get handed: the database and the operation of devices, of this application."""

from typing import Annotated

from fastapi import Depends, Request

from service.database.engine import Database
from service.devices.operation import Operation


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _operation(request: Request) -> Operation:
    operation: Operation = request.app.state.operation
    return operation


DatabaseDep = Annotated[Database, Depends(_database)]
OperationDep = Annotated[Operation, Depends(_operation)]
