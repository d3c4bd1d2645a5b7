"""Storages of studies: patience with a database that is away, those that are none, and Optuna's proxy."""

import copy
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from multiprocessing import get_context

import grpc
import optuna
import pytest
from ledgers import forked
from optuna.exceptions import StorageInternalError
from optuna.storages._rdb.models import BaseModel
from sqlalchemy import event
from studies import GRACE, assert_each_run_once, make_sweep, pretend_to_train

from benchmark.sweeps import storages
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.endings import errors_in_words
from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.storages import StorageError, open_storage, patiently, reason_of, without_password
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs


@pytest.mark.parametrize("error", [StorageInternalError, ConnectionError])
def test_patience_with_a_database_that_is_away(clock, error):
    answers = iter([error("away")] * 6)

    def call(argument):
        answer = next(answers, None)
        if answer is not None:
            raise answer
        return argument

    assert patiently(call, "there") == "there"
    # Twice as long each time, up to five seconds
    assert clock.now == pytest.approx(0.1 + 0.2 + 0.4 + 0.8 + 1.6 + 3.2)


def test_a_long_patience_is_announced_once(clock, capsys):
    def of(patience, n_failures):
        answers = iter([StorageInternalError("away")] * n_failures)

        def call():
            for error in answers:
                raise error

        patiently(call, patience=patience)
        return capsys.readouterr().err

    assert of(300.0, 4) == "The storage does not answer (away): trying for 300 s\n"
    assert of(300.0, 0) == of(storages.TABLES_TIMEOUT, 1) == ""


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("postgresql://me:secret@host/sweeps", "postgresql://me:***@host/sweeps"),
        ("grpc://me:secret@host", "grpc://me:***@host"),
        ("sqlite:///logs/studies.db", "sqlite:///logs/studies.db"),
        ("postgresql//me:secret@host/sweeps", "***"),
        ("postgresql://me:secret@host:port/sweeps", "***"),
        ("studies.db", "studies.db"),
    ],
)
def test_no_password_is_shown(url, shown):
    assert without_password(url) == shown


@pytest.mark.parametrize(
    "url",
    ["nosuch://me:secret@host/x", "nosuch//me:secret@host/x", "grpc://me:secret@host", "mysql+nosuch://me:secret@host/x"],
)
def test_messages_on_storages_have_no_password(url):
    with pytest.raises(ValueError, match=r"The value of `storage` is '.*\*\*\*") as error:
        open_storage(url)
    assert "secret" not in str(error.value)


def test_patience_has_an_end(clock):
    def call():
        raise StorageInternalError("away")

    with pytest.raises(StorageError, match=r"^away$") as error:
        patiently(partial(patiently, call, patience=1.0), patience=20.0)
    assert isinstance(error.value.__cause__, StorageError)
    assert 10 < clock.now <= 20


def test_the_reason_of_a_proxy_that_is_away_is_that_of_the_connection():
    with grpc.insecure_channel("127.0.0.1:1") as channel, pytest.raises(grpc.RpcError) as error:
        channel.unary_unary("/service/method")(b"", timeout=30)
    assert "Failed to connect to remote host" in reason_of(error.value)


def test_the_reason_of_an_error_without_a_text_is_its_class():
    assert reason_of(ConnectionError()) == "ConnectionError"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (StorageError("away"), r"^Error: the storage does not answer: away\. When it does, the same command continues\.$"),
        (BrokenPipeError("of a simulator"), "^Error: of a simulator$"),
    ],
)
def test_a_command_that_ends_blames_the_storage_for_its_own_errors_only(error, message):
    with pytest.raises(SystemExit, match=message), errors_in_words():
        raise error


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda study: pickle.loads(pickle.dumps(study))])
def test_a_study_can_be_copied(copier, tmp_path):
    study = optuna.create_study(storage=open_storage(f"sqlite:///{tmp_path / 'studies.db'}"), study_name="study")
    study.tell(study.ask(), 1.0)
    assert copier(study).best_value == 1.0


def test_no_patience_with_other_errors(clock):
    def call():
        raise KeyError("no such study")

    with pytest.raises(KeyError):
        patiently(call)
    assert clock.now == 0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("grpc://localhost", "must have a host and a port"),
        ("studies.db", "must be a database's URL"),
        ("nosuchdatabase://localhost/x", "must be a database's URL"),
        ("sqlite://", "in the memory of one process, but must be one that other processes reach, such as sqlite:///"),
        ("sqlite:///", "in the memory of one process"),
        ("sqlite:///:memory:", "in the memory of one process"),
        ("sqlite+pysqlite:///:memory:", "in the memory of one process"),
        ("sqlite:///file::memory:?cache=shared&uri=true", "in the memory of one process"),
        ("sqlite:///file:mine?mode=memory&uri=true", "in the memory of one process"),
    ],
)
def test_a_storage_that_is_none(url, message):
    with pytest.raises(ValueError, match=message):
        open_storage(url)


def test_a_missing_file_is_only_created_on_demand(tmp_path):
    url = f"sqlite:///{tmp_path}/folder/studies.db"
    with pytest.raises(ValueError, match=f"there is no file {tmp_path}/folder/studies.db: give the --storage"):
        open_storage(url, create=False)
    assert list(tmp_path.iterdir()) == []
    open_storage(url)
    assert open_storage(url, create=False).get_all_studies() == []


def test_processes_that_make_a_database_at_once(tmp_path):
    for attempt in range(3):
        url = f"sqlite:///{tmp_path}/{attempt}/studies.db"
        children = [forked(lambda url=url: open_storage(url).get_all_studies()) for _ in range(4)]
        assert [os.waitpid(child, 0)[1] for child in children] == [0] * 4


@pytest.mark.parametrize("is_empty_file", [False, True])
def test_processes_create_the_tables_one_after_another(is_empty_file, tmp_path, monkeypatch):
    """Without patience, as on a machine that is too busy: each would find no tables while the others create them."""
    monkeypatch.setattr(storages, "TABLES_TIMEOUT", 0.0)
    started = get_context("fork").Barrier(3)
    if is_empty_file:
        (tmp_path / "studies.db").touch()

    def create():
        event.listen(BaseModel.metadata, "before_create", lambda *args, **kwargs: time.sleep(0.3))
        started.wait(60)
        open_storage(f"sqlite:///{tmp_path}/studies.db").get_all_studies()

    assert [os.waitpid(child, 0)[1] for child in [forked(create) for _ in range(3)]] == [0] * 3


def test_a_file_with_all_tables_is_opened_without_the_lock(tmp_path, monkeypatch):
    url = f"sqlite:///{tmp_path}/studies.db"
    open_storage(url)
    monkeypatch.setattr(storages, "FileLock", lambda *args, **kwargs: pytest.fail("waits for the lock"))
    assert open_storage(url).get_all_studies() == []


def test_a_file_on_a_file_system_without_locks_is_opened(tmp_path, fail_to_lock):
    fail_to_lock()
    # Created by a process that was killed
    (tmp_path / "studies.db.lock").touch()
    start = time.monotonic()
    assert open_storage(f"sqlite:///{tmp_path}/studies.db").get_all_studies() == []
    assert time.monotonic() - start < storages.SQLITE_TIMEOUT / 2


PROXY = """
import optuna, sys
optuna.storages.run_grpc_proxy_server(optuna.storages.get_storage(sys.argv[1]), host="127.0.0.1", port=int(sys.argv[2]))
"""


def test_by_way_of_optunas_proxy(monkeypatch, tmp_path):
    """... which is killed in the middle, and comes back."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-c", PROXY, f"sqlite:///{tmp_path}/studies.db", str(port)]
    sweep = make_sweep(seeds=3)
    servers = []

    def serve():
        servers.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def train(run, *args):
        if run.seed == 2 and len(servers) == 1:
            servers[0].kill()
            servers[0].wait()
            serve()
        return pretend_to_train(run, *args)

    monkeypatch.setattr(worker, "train", train)
    serve()
    try:
        storage = open_storage(f"grpc://127.0.0.1:{port}")
        ledger = Ledger(storage, "study", GRACE)
        ledger.open(sweep, {"experiment": sweep.name})
        execute_runs(ledger, tmp_path, "a process")
        assert len(servers) == 2
        assert_each_run_once(ledger.trials(), sweep)
        assert len(ledger.records()) == 6
        assert all("beat" in trial.user_attrs[PROGRESS] for trial in ledger.trials())
    finally:
        for server in servers:
            server.send_signal(signal.SIGKILL)
            server.wait()
