"""Studies of runs that train nothing, and processes that work them off and die, for the tests of sweeps."""

import random
import threading
import time
from collections import Counter
from types import SimpleNamespace

from optuna.trial import TrialState

from benchmark.sweeps import locks, storages
from benchmark.sweeps import worker_loop as worker
from benchmark.sweeps.experiments import Sweep
from benchmark.sweeps.runs import Run
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import ERROR, KEY, owned
from benchmark.sweeps.sweep_files import Method, SweepFile
from sb3_cgp.resumption.store import StateStore

GRACE = 60.0


def make_sweep(methods=("Good", "Bad"), seeds=2, **fields):
    """Of methods that need no training: "Bad" fails for its own reasons."""
    known = {name: Method(algo="td3", hyperparams={"policy": "MlpPolicy"}) for name in ("Good", "Bad", "Other")}
    content = dict(title="A test", methods=list(known), tasks=["Pendulum-v1"], steps=100, seeds=seeds, evaluation_interval=50)
    return Sweep("tiny", SweepFile.model_validate(content | fields), {name: known[name] for name in methods})


def pretend_to_train(run, folder, report, watch, device):
    """Give what a run's training gives, by its seed alone."""
    watch(50)
    report(50, float(run.seed))
    watch(100)
    report(100, 10.0 * run.seed)
    if run.method == "Bad":
        raise FloatingPointError("not a number")
    return 100.0 * run.seed


def pretend_to_train_group(group, folders, claimed, watch, device):
    """Give what a group's training gives, and save a state on the way."""
    assert len(folders) == len(group.runs) > 1
    group.write()
    StateStore(group.states, keep=1).save(1, {})
    finals = {}
    for index, run in enumerate(group.runs):
        try:
            finals[index] = pretend_to_train(
                run, folders[index], lambda *point, run=run: claimed.report(run, *point), watch, ""
            )
        except FloatingPointError as error:
            claimed.fail(run, error)
    return finals


class Clock:
    """Time that passes when it is told to."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Heart:
    """A heart that beats with the training, so that a process makes its calls one after another."""

    def __init__(self, beat, interval, parent):
        self.beat, self.count = beat, 0

    def __enter__(self):
        self.watch(0)
        return self

    def __exit__(self, *exception):
        pass

    def watch(self, step):
        self.beat(f"{id(self)}-{self.count}", step, 1.0)
        self.count += 1


def pretend(monkeypatch, clock):
    """Let workers train nothing, and wait for nothing."""
    monkeypatch.setattr(worker, "train", pretend_to_train)
    monkeypatch.setattr(worker, "train_group", pretend_to_train_group)
    monkeypatch.setattr(worker, "HeartbeatThread", Heart)
    lock = SimpleNamespace(acquire=lambda: None, release=lambda: None)
    monkeypatch.setattr(locks, "FolderLock", lambda folder: lock)
    times = SimpleNamespace(sleep=clock.sleep, monotonic=clock, strftime=time.strftime)
    monkeypatch.setattr(worker, "time", times)
    monkeypatch.setattr(storages, "time", times)


class Killed(BaseException):
    """The end of a process."""


class Line:
    """
    A process's line to a storage.

    :param storage: the storage
    :param fault: is asked before each call: a pair of an error and whether the call takes effect before it; or None
    """

    def __init__(self, storage, fault):
        self.storage, self.fault = storage, fault
        self.is_dead = False

    def __getattr__(self, name):
        def call(*args, **kwargs):
            if self.is_dead:
                raise Killed
            error, takes_effect = self.fault() or (None, True)
            self.is_dead = error is Killed
            result = getattr(self.storage, name)(*args, **kwargs) if takes_effect else None
            if error is not None:
                raise error
            return result

        return call


def work_through(storage, sweep, clock, logs, population=1):
    """Do what a process of a sweep does."""
    ledger = Ledger(storages.patient(storage), "study", GRACE, clock)
    ledger.open(sweep, {"experiment": sweep.name})
    worker.execute_runs(ledger, logs, "a process", population=population)


def mortal(storage, sweep, clock, logs, calls, takes_effect, population=1):
    """
    Do the same in a process that dies at a call.

    :return: whether it died
    """
    left = iter([None] * calls)
    line = Line(storage, lambda: next(left, (Killed, takes_effect)))
    try:
        work_through(line, sweep, clock, logs, population)
    except Killed:
        return True
    return False


class Crew:
    """
    Processes whose calls come in an order drawn at random, and which die or lose answers at random.

    :param seed: of the draw
    :param storage: the storage that they share
    :param clock: their clock
    :param population: the most runs that each of them trains together
    """

    def __init__(self, seed, storage, clock, population=1):
        self.draw = random.Random(seed)
        self.storage, self.clock, self.population = storage, clock, population

    def work(self, sweep, logs, n_processes, n_deaths, n_steps):
        """Work a sweep off, with new processes for those that die."""
        crew = [_Member(self, sweep, logs) for _ in range(n_processes)]
        for _ in range(n_steps):
            crew = [member for member in crew if member.is_alive]
            if not crew and n_deaths <= 0:
                return
            if not crew or (n_deaths > 0 and len(crew) < n_processes):
                crew.append(_Member(self, sweep, logs))
            member = self.draw.choice(crew)
            chance = self.draw.random()
            takes_effect = self.draw.random() < 0.5
            if n_deaths > 0 and chance < 0.05:
                n_deaths -= 1
                member.next_fault = Killed, takes_effect
            elif chance < 0.1:
                member.next_fault = ConnectionError, takes_effect
            elif chance < 0.13:
                # All but this one are away for long
                for _ in range(round(GRACE)):
                    self.clock.sleep(2)
                    member.step()
                    if not member.is_alive:
                        break
                continue
            self.clock.sleep(self.draw.uniform(0, 2))
            member.step()
        raise AssertionError("it does not come to its end")


class _Member:
    """One process, as a thread that makes a call when it is told to."""

    def __init__(self, crew, sweep, logs):
        self.next_fault = None
        self.is_alive, self.error = True, None
        self._go, self._is_ready = threading.Semaphore(0), threading.Semaphore(0)
        line = Line(crew.storage, self._fault)
        self._thread = threading.Thread(target=self._run, args=(line, sweep, crew.clock, logs, crew.population))
        self._thread.start()
        self._is_ready.acquire()

    def step(self):
        self._go.release()
        self._is_ready.acquire()
        if not self.is_alive:
            self._thread.join()
        if self.error is not None:
            raise self.error

    def _fault(self):
        self._is_ready.release()
        self._go.acquire()
        fault, self.next_fault = self.next_fault, None
        return fault

    def _run(self, *args):
        try:
            work_through(*args)
        except Killed:
            pass
        except BaseException as error:
            self.error = error
        self.is_alive = False
        self._is_ready.release()


def assert_each_run_once(trials, sweep):
    """See that a study has each run of a sweep exactly once, with its curve, and that nothing is left to do."""
    trials = [trial for trial in trials if KEY in trial.user_attrs]
    assert all(trial.state.is_finished() for trial in trials)
    runs = {run.key: run for run in sweep.runs()}
    good = {key for key, run in runs.items() if run.method != "Bad"}
    completed = Counter(trial.user_attrs[KEY] for trial in trials if trial.state is TrialState.COMPLETE)
    assert completed == Counter(good)
    owners = owned(trials)
    assert owners.keys() == runs.keys()
    for key, run in runs.items():
        assert Run(**owners[key].user_attrs["run"]) == run
        assert owners[key].intermediate_values == {50: run.seed, 100: 10 * run.seed}
        assert owners[key].value == (100 * run.seed if key in good else None)
        assert owners[key].user_attrs.get(ERROR) == (None if key in good else "FloatingPointError: not a number")
