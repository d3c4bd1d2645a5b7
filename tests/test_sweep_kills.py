"""Sweeps whose workers and database are killed at random moments, by a signal that no process can catch."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import psutil
import pytest
import torch as th
import yaml
from optuna.trial import TrialState
from postgres import Server

from benchmark import worker
from benchmark.common.records import read_records
from benchmark.sweeps import worker_loop
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.exports import export_study
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import KEY

REPOSITORY = Path(__file__).resolve().parent.parent
BEAT, GRACE = 0.3, 2.0
# Seconds: for what hangs, not for what is slow on a busy machine
PATIENCE = 900


def write_sweep(folder, **fields):
    """A sweep of runs that take a second or two."""
    content = dict(
        title="Tiny runs",
        methods=["CGP-Online", "TD3", "Random"],
        tasks=["Pendulum-v1"],
        steps=300,
        seeds=2,
        evaluation_interval=100,
        evaluation_episodes=1,
        checkpoint_interval=50,
        hyperparams=dict(learning_starts=50, batch_size=8, policy_kwargs="dict(net_arch=[8, 8])"),
    )
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump(content | fields))
    return path


def forked(act, *args):
    """Do something in a child process, so that no connection is shared with others, and return its number."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            th.set_num_threads(1)
            act(*args)
            status = 0
        except SystemExit as exit:
            status = exit.code
        finally:
            os._exit(status)
    return child


def in_child(act, *args):
    assert os.waitpid(forked(act, *args), 0)[1] == 0


class Study:
    """
    A study, its workers, and what became of it.

    :param folder: for logs and results
    :param url: the database
    :param name: the study's name
    :param sweep: the sweep's file
    """

    # Further options of the workers
    options = ()

    def __init__(self, folder, url, name, sweep):
        self.folder, self.url, self.name, self.sweep = folder, url, name, sweep
        self.workers = set()
        in_child(self._open)

    def _open(self):
        sweep = load_sweep(str(self.sweep))
        Ledger(open_storage(self.url), self.name).open(sweep, {"experiment": sweep.name})

    def _work(self):
        sys.stdout = sys.stderr = open(self.folder / "workers.log", "a")  # noqa: SIM115
        command = ["--study", self.name, "--storage", self.url, "--logs", str(self.folder / "logs"), "--device", "cpu"]
        worker_loop.PAUSE = 0.2
        worker.main([*command, *self.options, "--beat", str(BEAT), "--grace", str(GRACE)])

    def man(self, n_workers):
        """
        Start as many workers as are missing.

        :return: whether all is over
        """
        for child in list(self.workers):
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                self.workers.remove(child)
                assert status in (0, signal.SIGKILL), (self.folder / "workers.log").read_text()[-3000:]
                if status == 0:
                    return True
        while len(self.workers) < n_workers:
            self.workers.add(forked(self._work))
        return False

    def kill(self, workers):
        for child in workers:
            os.kill(child, signal.SIGKILL)

    def end(self):
        """Let no worker outlive the test."""
        self.kill(self.workers)
        for child in self.workers:
            os.waitpid(child, 0)

    def records(self):
        """
        Read the study, and see that each of its runs is there once.

        :return: all that is known of its runs, but for times
        """
        in_child(self._export)
        trials = json.loads((self.folder / "trials.json").read_text())
        runs = load_sweep(str(self.sweep)).runs()
        assert Counter(key for key, state in trials if state == "COMPLETE") == Counter(run.key for run in runs)
        assert {state for _, state in trials} <= {"COMPLETE", "FAIL"}
        return [
            asdict(record) | {"seconds": None, "processor_seconds": None} for record in read_records(self.folder / self.name)
        ]

    def _export(self):
        export_study(self.name, self.url, self.folder)
        trials = Ledger(open_storage(self.url), self.name).trials()
        states = [(trial.user_attrs[KEY], TrialState(trial.state).name) for trial in trials]
        (self.folder / "trials.json").write_text(json.dumps(states))


def undisturbed(folder, sweep):
    folder.mkdir()
    study = Study(folder, f"sqlite:///{folder}/studies.db", "undisturbed", sweep)
    try:
        in_child(study._work)
        return study.records()
    finally:
        study.end()


def disturbed(folder, url, sweep, draw, least, server=None):
    """
    Work a study off while its workers and its database are killed, until that has happened often enough.

    :return: what is known of its runs, and how often something was killed
    """
    study, kills = Study(folder, url, folder.name, sweep), Counter()
    try:
        end = time.monotonic() + PATIENCE
        while not study.man(2):
            assert time.monotonic() < end, (folder / "workers.log").read_text()[-3000:]
            time.sleep(draw.uniform(0.2, 2.5))
            if kills.total() >= least:
                continue
            victim = draw.choices(["a worker", "all workers", "the server"], [5, 2, 3 if server else 0])[0]
            kills[victim] += 1
            if victim == "the server":
                server.kill()
                time.sleep(draw.uniform(0, 1.5 * GRACE))
                server.start()
            else:
                study.kill(study.workers if victim == "all workers" else [draw.choice(sorted(study.workers))])
        return study.records(), kills
    finally:
        study.end()


def check(tmp_path, least, url_of, server=None, **sweep):
    """See that studies whose parts are killed at least so often equal one that is left alone."""
    path = write_sweep(tmp_path, **sweep)
    expected = undisturbed(tmp_path / "undisturbed", path)
    draw, kills = random.Random(0), Counter()
    while kills.total() < least:
        folder = tmp_path / f"disturbed-{kills.total()}"
        folder.mkdir()
        records, killed = disturbed(folder, url_of(folder), path, draw, least - kills.total(), server)
        assert records == expected
        kills += killed
    return kills


@pytest.fixture(autouse=True)
def _short_final_evaluation(monkeypatch):
    # Most of a tiny run's time otherwise
    monkeypatch.setattr("benchmark.sweeps.run.FINAL_EPISODES", 2)


@pytest.fixture
def server():
    with Server() as server:
        yield server


@pytest.mark.slow
def test_workers_and_postgresql_killed_twenty_times(tmp_path, server):
    kills = check(tmp_path, 24, lambda folder: server.url, server)
    assert kills.total() >= 24
    assert min(kills[victim] for victim in ("a worker", "all workers", "the server")) >= 3


def test_workers_killed_with_sqlite(tmp_path):
    kills = check(tmp_path, 4, lambda folder: f"sqlite:///{folder}/studies.db", steps=200, seeds=1)
    assert kills.total() >= 4


def command_of(sweep, folder, *args):
    """The command line of a sweep with files of its own."""
    folders = ["--logs", str(folder / "logs"), "--results", str(folder / "results")]
    timing = ["--beat", str(BEAT), "--grace", str(GRACE), "--threads", "1"]
    return [sys.executable, "-m", "benchmark.sweep", str(sweep), *folders, *timing, *args]


@contextmanager
def started(command, home):
    """Start a sweep, and see that nothing of it outlives the test."""
    home.mkdir(exist_ok=True)
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": str(REPOSITORY)}
    with open(home / "output.log", "ab") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=home, env=environment)
    try:
        yield process
    finally:
        for each in [process, *family(process)]:
            with suppress(psutil.NoSuchProcess):
                each.kill()
        process.wait()


def family(process):
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def wait_until(condition, what):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.2)


def trials_of(url, study):
    storage = open_storage(url)
    names = [each.study_name for each in storage.get_all_studies()]
    return Ledger(storage, study).trials() if study in names else []


def training(url):
    """The trials of runs that are being trained."""
    trials = trials_of(url, "tiny")
    return [trial for trial in trials if trial.state is TrialState.RUNNING and "progress" in trial.user_attrs]


@pytest.mark.slow
@pytest.mark.usefixtures("heeds_interruptions")
def test_a_sweeps_command_is_killed_interrupted_and_goes_on(tmp_path):
    sweep = write_sweep(tmp_path, steps=8000, methods=["TD3"], checkpoint_interval=100)
    url = f"sqlite:///{tmp_path}/studies.db"
    command = command_of(sweep, tmp_path, "--workers", "2", "--storage", url)
    with started(command, tmp_path / "home") as process:
        wait_until(lambda: len(training(url)) == 2, "no run has begun")
        workers = family(process)
        assert len(workers) >= 2
        process.kill()
        # They see by themselves that their parent is gone
        assert psutil.wait_procs(workers, timeout=60)[1] == []
        # They have given back what they had
        assert [trial.state for trial in trials_of(url, "tiny")] == [TrialState.FAIL] * 2 + [TrialState.WAITING] * 2
    with started(command, tmp_path / "home") as process:
        wait_until(lambda: training(url), "no run was taken up")
        workers = family(process)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == 128 + signal.SIGINT
        assert psutil.wait_procs(workers, timeout=10)[1] == []
        # What was not finished was given back at once, and nothing waits for the grace
        assert TrialState.RUNNING not in [trial.state for trial in trials_of(url, "tiny")]
        assert "The same command continues." in (tmp_path / "home" / "output.log").read_text()
    with started(command, tmp_path / "home") as process:
        assert process.wait(timeout=PATIENCE) == 0, (tmp_path / "home" / "output.log").read_text()[-3000:]
    trials = trials_of(url, "tiny")
    completed = Counter(trial.user_attrs[KEY] for trial in trials if trial.state is TrialState.COMPLETE)
    assert completed == Counter(run.key for run in load_sweep(str(sweep)).runs())


@pytest.mark.slow
def test_two_machines_share_a_study_by_the_databases_url_alone(tmp_path, server):
    """Two commands that are started at once, with nothing in common but the database."""
    sweep = write_sweep(tmp_path, seeds=3)
    homes = [tmp_path / "here", tmp_path / "there"]
    here, there = ([*command_of(sweep, home), "--storage", server.url] for home in homes)
    with started(here, homes[0]) as first, started(there, homes[1]) as second:
        for process, home in ((first, homes[0]), (second, homes[1])):
            assert process.wait(timeout=PATIENCE) == 0, (home / "output.log").read_text()[-3000:]
    runs = load_sweep(str(sweep)).runs()
    trials = trials_of(server.url, "tiny")
    completed = [trial for trial in trials if trial.state is TrialState.COMPLETE]
    assert Counter(trial.user_attrs[KEY] for trial in completed) == Counter(run.key for run in runs)
    # Both have done their share
    assert len({trial.user_attrs["worker"] for trial in completed}) == 2
    exported = [read_records(home / "results" / "tiny") for home in homes]
    assert exported[0] == exported[1]
    assert len(exported[0]) == len(runs)
