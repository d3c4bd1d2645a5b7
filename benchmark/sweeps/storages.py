"""Opening Optuna's storages for many processes at once, and repeating calls while a database does not answer."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast
from urllib.parse import urlsplit

import grpc
import optuna
from alembic.migration import MigrationContext
from filelock import FileLock
from optuna.storages import BaseStorage, GrpcStorageProxy, RDBStorage, get_storage
from sqlalchemy import create_engine, event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from sb3_cgp.common.extras import how_to_install

Result = TypeVar("Result")


class StorageError(RuntimeError):
    """A storage has not answered for as long as a call was patient. Only calls of storages raise it, no environment does."""


# Errors of the database, and not of the call, if a storage raises them. Optuna does not convert all of SQLAlchemy's errors.
STORAGE_ERRORS = (StorageError, optuna.exceptions.StorageInternalError, SQLAlchemyError, grpc.RpcError, ConnectionError)
DEFAULT_STORAGE = "sqlite:///logs/sweeps/studies.db"
# Seconds that SQLite waits for another process's writing
SQLITE_TIMEOUT = 120
# Seconds of patience with other processes that are making the same tables
TABLES_TIMEOUT = 5.0


def open_storage(url: str, create: bool = True) -> BaseStorage:
    """
    Open a storage, and create it if it is a file of SQLite that is missing.

    :param url: SQLAlchemy's URL of a database, or ``grpc://host:port`` of Optuna's proxy in front of one
    :param create: whether a missing file is created; if not, it is refused
    :return: the storage, with the patience of :func:`patient`
    :raises ValueError: if it is neither, the database's driver is not installed, the database is in memory, or its file is
        missing and not to be created
    :raises StorageError: if the database does not answer
    """
    parts = urlsplit(url)
    if parts.scheme == "grpc":
        if parts.hostname is None or parts.port is None:
            raise ValueError(
                f"The value of `storage` is {without_password(url)!r}, but must have a host and a port, as in grpc://localhost:13000"
            )
        return patient(GrpcStorageProxy(host=parts.hostname, port=parts.port))
    database = _read_url(url)
    if database.get_backend_name() != "sqlite":
        return patient(get_storage(_open_database(database, {"pool_pre_ping": True})))
    # SQLite's own URLs of files are left to it
    path = Path(database.database or "")
    if not create and not path.exists() and "uri" not in database.query:
        raise ValueError(
            f"The value of `storage` is {without_password(url)!r}, but there is no file {path}: give the --storage of the "
            "command that has begun the study, from the same folder"
        )
    return patient(get_storage(_open_sqlite(database)))


def without_password(url: str) -> str:
    """
    Return a storage's URL as messages name it.

    :param url: the URL
    :return: the URL with stars in place of a password; of a text that is no URL, and may hold one, only stars
    """
    try:
        return make_url(url).render_as_string(hide_password=True)
    except (ArgumentError, ValueError):
        return "***" if "@" in url else url


def _read_url(url: str) -> URL:
    shown = without_password(url)
    try:
        database = make_url(url)
        # SQLAlchemy's default driver for PostgreSQL depends on its version
        if database.drivername == "postgresql":
            database = database.set(drivername="postgresql+psycopg2")
        is_in_memory = database.get_backend_name() == "sqlite" and _is_in_memory(database)
        if not is_in_memory:
            # Imports the driver
            create_engine(database)
    except ModuleNotFoundError as error:
        extra = f" It is in the extra `sweeps`: {how_to_install('sweeps')}" if error.name == "psycopg2" else ""
        raise ValueError(
            f"The value of `storage` is {shown!r}, and its driver {error.name} is not installed.{extra}"
        ) from error
    except (ArgumentError, ImportError, ValueError) as error:
        # The reason may quote a text that is no URL
        reason = "" if shown == "***" else f": {error}"
        raise ValueError(f"The value of `storage` is {shown!r}, but must be a database's URL{reason}") from error
    if is_in_memory:
        raise ValueError(
            f"The value of `storage` is {shown!r}, a database in the memory of one process, but must be one that other "
            f"processes reach, such as {DEFAULT_STORAGE}"
        )
    return database


def _is_in_memory(database: URL) -> bool:
    """Return whether a database of SQLite is in memory, as its URL says it in one of several ways."""
    name = database.database or ""
    return name in ("", "file:") or ":memory:" in name or database.query.get("mode") == "memory"


def _open_sqlite(database: URL) -> RDBStorage:
    """
    Open a file of SQLite. Processes that find it without Optuna's tables create them one after another.

    The lock is a file beside it. A file that has all tables is opened without the lock.
    """
    assert database.database is not None
    path = Path(database.database)
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        if not patiently(_has_tables, database, patience=0.0):
            # On a file system without locks, processes collide, and repeat what has failed
            with suppress(OSError):
                stack.enter_context(FileLock(f"{path}.lock", timeout=SQLITE_TIMEOUT, fallback_to_soft=False))
        storage = _open_database(database, {"connect_args": {"timeout": SQLITE_TIMEOUT}})
    _make_transactions_exclusive(storage)
    return storage


def _has_tables(database: URL) -> bool:
    """Return whether Optuna has created all tables: it notes the revision of their schema last."""
    engine = create_engine(database, connect_args={"timeout": SQLITE_TIMEOUT})
    try:
        with engine.connect() as connection:
            return MigrationContext.configure(connection).get_current_revision() is not None
    finally:
        engine.dispose()


def _open_database(database: URL, engine_kwargs: dict[str, Any]) -> RDBStorage:
    url = database.render_as_string(hide_password=False)
    # Of several processes that find no tables, all but one fail to create them
    return patiently(RDBStorage, url, engine_kwargs, patience=TABLES_TIMEOUT)


def _make_transactions_exclusive(storage: RDBStorage) -> None:
    """
    Let a transaction of SQLite lock the database from its start, as SQLAlchemy's documentation does it.

    Otherwise two processes may both read that a trial waits before either writes that it takes it.
    """

    @event.listens_for(storage.engine, "connect")
    def disable_the_drivers_transactions(connection: Any, record: Any) -> None:
        connection.isolation_level = None

    @event.listens_for(storage.engine, "begin")
    def begin(connection: Any) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    # Close the connections that were opened without these listeners
    storage.engine.dispose()


def reason_of(error: BaseException) -> str:
    """
    Return why a storage does not answer.

    :param error: one of ``STORAGE_ERRORS``
    :return: the first line of the error that Optuna's error was raised from, or its class if it has no text
    """
    cause = error if isinstance(error, StorageError) else error.__cause__ or error
    text = cause.details() if isinstance(cause, grpc.Call) else str(cause)
    return text.splitlines()[0] if text else type(cause).__name__


def patiently(call: Callable[..., Result], *args: Any, patience: float = 300.0, **kwargs: Any) -> Result:
    """
    Repeat a call of a storage while its database does not answer.

    A call that has taken effect although its answer was lost is made twice, which must do no harm.

    :param call: a method of the storage
    :param args: its arguments
    :param patience: seconds after which it is given up
    :param kwargs: its arguments
    :return: the result of the call
    :raises StorageError: if the database has not answered until then
    """
    start, pause, is_told = time.monotonic(), 0.1, False
    while True:
        try:
            return call(*args, **kwargs)
        except STORAGE_ERRORS as error:
            if time.monotonic() - start + pause > patience:
                raise StorageError(reason_of(error)) from error
            if not is_told and patience > TABLES_TIMEOUT:
                print(
                    f"The storage does not answer ({reason_of(error)}): trying for {patience:.0f} s",
                    file=sys.stderr,
                    flush=True,
                )
                is_told = True
            time.sleep(pause)
            pause = min(2 * pause, 5.0)


def patient(storage: BaseStorage) -> BaseStorage:
    """
    Let each call of a storage be repeated by :func:`patiently`, those that Optuna makes included.

    Repeating a method of Optuna's study, which makes several calls, would leave what its first calls have done: ``ask`` would
    take two trials. What a storage has done although its answer was lost is still done twice: of two equal trials, the
    studies here use one, and a trial that was taken and is unknown to its process is lost after the grace period.

    :param storage: the storage
    :return: an object with the storage's methods. Optuna asks for a storage's class only to wrap an ``RDBStorage``, as
        ``get_storage`` does, and for Optuna's own heartbeat, which is not used here.
    """
    return cast(BaseStorage, _Patient(storage))


class _Patient:
    def __init__(self, storage: BaseStorage):
        self._storage = storage

    def __getattr__(self, name: str) -> Any:
        # A copy has no storage yet when it is asked for its own methods
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(patiently, getattr(self._storage, name))
