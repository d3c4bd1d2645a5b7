"""A population whose process, or whose environments' processes, are killed, continues."""

import json
import os
import signal
import time

import numpy as np
import pytest
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from optuna.storages import InMemoryStorage
from sweep_populations import NOISE, in_processes, study_of, write_sweep
from test_sweep_kills import Study

from benchmark.common.records import EVALUATION_SEED
from benchmark.sweeps.environment_processes import close_environments
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs
from sb3_cgp.population import ChunkedSubprocVecEnv
from sb3_cgp.resumption.store import StateStore

pytestmark = pytest.mark.usefixtures("short_final_evaluation")


class Ending:
    """
    Lets ``Pendulum-v1`` end its own process, where that is not the test's.

    :param how: a signal, or None for an exception
    :param when: the environment's step: 35 is in the training, 70 in its first evaluation. None is the final evaluation.
    """

    def __init__(self, monkeypatch, how, when):
        self.how, self.process = how, os.getpid()
        reset, step, ending = PendulumEnv.reset, PendulumEnv.step, self

        def ending_reset(self, *, seed=None, options=None):
            ending.end(when is None and seed == EVALUATION_SEED)
            return reset(self, seed=seed, options=options)

        def ending_step(self, action):
            self.steps = getattr(self, "steps", 0) + 1
            ending.end(self.steps == when)
            return step(self, action)

        monkeypatch.setattr(PendulumEnv, "reset", ending_reset)
        monkeypatch.setattr(PendulumEnv, "step", ending_step)

    def end(self, now):
        if now and os.getpid() != self.process:
            if self.how is None:
                raise ValueError("the simulator's own error")
            os.kill(os.getpid(), self.how)


@pytest.mark.parametrize(("how", "when"), [(None, 35), (None, None), (signal.SIGABRT, 70)])
def test_an_environment_that_ends_its_own_process_dissolves_the_population(tmp_path, monkeypatch, how, when):
    in_processes(monkeypatch)
    Ending(monkeypatch, how, when)
    ledger = study_of(write_sweep(tmp_path, {"A": ("td3", {})}, steps=90), 8, tmp_path / "logs")
    outcomes = [trial.user_attrs.get("outcome", "") for trial in ledger.trials()]
    assert [outcome.partition(":")[0] for outcome in outcomes] == ["dissolved"] * 2 + [""] * 2
    assert ("exit code 1" if how is None else "signal 6") in outcomes[0]
    # Alone, a run is trained in this process
    assert [record.error for record in ledger.records()] == [None, None]


@pytest.mark.parametrize(
    ("how", "error", "when"),
    [(signal.SIGKILL, ChildProcessError, when) for when in (35, 70, None)] + [(signal.SIGTERM, SystemExit, 35)],
)
def test_a_population_whose_environments_are_killed_goes_on_from_its_state(tmp_path, monkeypatch, how, error, when):
    in_processes(monkeypatch)
    path = write_sweep(tmp_path, {"A": ("td3", {})}, steps=90)
    straight = study_of(path, 8, tmp_path / "straight")
    ending = Ending(monkeypatch, how, when)
    sweep, ledger = load_sweep(str(path)), Ledger(InMemoryStorage(), "tiny")
    ledger.open(sweep, {"experiment": sweep.name})
    with pytest.raises(error) as raised:
        execute_runs(ledger, tmp_path / "logs", "a process", device="cpu", population=8)
    assert getattr(raised.value, "code", 143) == 143
    if how is signal.SIGKILL:
        (population,) = (tmp_path / "logs").glob("tiny/populations/*")
        assert f"from the beginning, remove {population}, and give --population" in str(raised.value)
    assert max(StateStore(next((tmp_path / "logs").glob("tiny/populations/*/state"))).steps()) >= 2 * 30
    monkeypatch.setattr(ending, "end", lambda now: None)
    execute_runs(ledger, tmp_path / "logs", "another process", device="cpu", population=8)
    assert [record.error for record in ledger.records()] == [None, None]
    finals = [{record.key: record.final for record in each.records()} for each in (straight, ledger)]
    assert finals[0] == finals[1]


def test_an_interrupt_of_all_processes_leaves_the_environments_to_the_main_process():
    env = ChunkedSubprocVecEnv([PendulumEnv] * 2, n_processes=2, start_method="fork")
    env.reset()
    for process in env.processes:
        os.kill(process.pid, signal.SIGINT)
    # Answered after the signal
    assert len(env.step(np.zeros((2, 1), np.float32))[0]) == 2
    env.step_async(np.zeros((2, 1), np.float32))
    env.remotes[0].recv()
    # An interrupted step has read one of two replies
    close_environments(env)
    assert env.closed
    assert not any(process.is_alive() for process in env.processes)


class Populations(Study):
    """A study whose one process trains populations."""

    options = ("--population", "8")

    def without_times(self):
        return [record | {"seconds": None, "processor_seconds": None} for record in self.records()]


def wait_for(condition, study):
    end = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < end, (study.folder / "workers.log").read_text()[-3000:]
        time.sleep(0.05)


@pytest.mark.usefixtures("short_episodes")
def test_a_population_whose_process_is_killed_goes_on_to_the_bit(tmp_path):
    methods = {"A": ("td3", NOISE), "B": ("td3", NOISE | dict(learning_rate=0.01))}
    path = write_sweep(tmp_path, methods, seeds=2, steps=300, evaluation_interval=100, checkpoint_interval=20)
    records = []
    for name, steps in (("straight", []), ("killed", [30, 120])):
        (tmp_path / name).mkdir()
        study = Populations(tmp_path / name, f"sqlite:///{tmp_path}/{name}/studies.db", name, path)
        try:
            for step in steps:
                study.man(1)

                def saved(name=name, step=step):
                    found = (tmp_path / name / "logs" / name / "populations").glob("*/state")
                    return any(max(StateStore(each).steps(), default=0) >= 4 * step for each in found)

                wait_for(saved, study)
                (child,) = study.workers
                os.kill(child, signal.SIGKILL)
                assert os.waitpid(child, 0)[1] == signal.SIGKILL
                study.workers.clear()
            wait_for(lambda study=study: study.man(1), study)
            records.append(study.without_times())
            trials = json.loads((study.folder / "trials.json").read_text())
            assert [state for _, state in trials].count("FAIL") == 4 * len(steps)
        finally:
            study.end()
    assert records[0] == records[1]
    assert {record["population"] for record in records[0]} == {4}
