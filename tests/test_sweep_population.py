"""Runs of a sweep that are trained as one population: each has its own record and folder, and continues after a kill."""

import json
import os
import random
import shutil
import signal
import time
from dataclasses import fields
from functools import partial

import numpy as np
import pytest
import torch as th
import yaml
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from optuna.storages import InMemoryStorage
from rl_zoo3 import ALGOS
from test_sweep_kills import Study
from test_sweep_run import Interruption, interrupt_at, policy_of, trained

from benchmark.common.records import EVALUATION_SEED, Record
from benchmark.reporting.figures import figures
from benchmark.reporting.run_curves import read_curve
from benchmark.reporting.zoo_runs import run_in
from benchmark.sweeps import population_run, worker_loop
from benchmark.sweeps.environment_processes import close_environments
from benchmark.sweeps.execution import describe
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.exports import export_study
from benchmark.sweeps.groups import Group
from benchmark.sweeps.population_run import train_group
from benchmark.sweeps.run import run_folder
from benchmark.sweeps.storages import open_storage
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.worker_loop import execute_runs
from sb3_cgp.population import ChunkedSubprocVecEnv
from sb3_cgp.resumption.store import StateStore

TINY = dict(policy="MlpPolicy", learning_starts=20, batch_size=8, buffer_size=400, policy_kwargs="dict(net_arch=[8, 8])")
CEM = dict(cem_samples=6, cem_elites=2, cem_dtype="float32")
NOISE = dict(noise_type="normal", noise_std=0.1)


@pytest.fixture(autouse=True)
def _short_final_evaluation(monkeypatch):
    # Most of a tiny run's time otherwise
    for module in ("run", "population_run"):
        monkeypatch.setattr(f"benchmark.sweeps.{module}.FINAL_EPISODES", 2)


def write_sweep(folder, methods, seeds=2, steps=120, **changes):
    """A sweep of methods, each an algorithm and hyperparameters."""
    content = dict(
        title="A sweep",
        methods={name: {"algo": algo, "hyperparams": TINY | hyperparams} for name, (algo, hyperparams) in methods.items()},
        tasks=["Pendulum-v1"],
        steps=steps,
        seeds=seeds,
        evaluation_interval=40,
        evaluation_episodes=1,
        checkpoint_interval=30,
    )
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump(content | changes))
    return path


@pytest.fixture
def runs_of(tmp_path):
    def make(methods, **fields):
        return load_sweep(str(write_sweep(tmp_path, methods, **fields))).runs()

    return make


class Taken:
    """What a population says of its runs, all of which this process has taken."""

    def __init__(self):
        self.reports, self.failures = {}, {}

    has_open = True

    def is_open(self, run):
        return run.key not in self.failures

    def report(self, run, step, value):
        self.reports[run.key, step] = value

    def fail(self, run, error):
        self.failures[run.key] = error


def train_together(runs, folder, *stops):
    """Train runs as a population, interrupting it at the given steps; return final returns and all that was reported."""
    group = Group.of(folder, runs)
    folders = [run_folder(folder, "study", run) for run in runs]
    for each in folders:
        each.mkdir(parents=True, exist_ok=True)
    for stop in [*stops, None]:
        taken = Taken()
        try:
            finals = train_group(group, folders, taken, (lambda step: None) if stop is None else interrupt_at(stop), "cpu")
        except Interruption:
            # Another process has other random numbers
            random.seed(stop)
            np.random.seed(stop)  # noqa: NPY002
        else:
            return finals, taken, folders


# SB3 says so when it loads any model with n-step returns
@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize(("algo", "own"), [("cgp", CEM | NOISE), ("td3", NOISE), ("ddpg", NOISE | {"n_steps": 3})])
def test_a_population_of_one_run_is_the_run_alone(tmp_path, runs_of, algo, own):
    """Environments, warm-up, minibatches, gradient steps, evaluations and files, on the same random numbers."""
    # A gamma that is exact in single precision
    (run,) = runs_of({"M": (algo, own | {"gamma": 0.5})}, seeds=[3])
    final, reports = trained(run, tmp_path / "alone")
    finals, taken, (folder,) = train_together([run], tmp_path / "together")
    assert finals == {0: pytest.approx(final, rel=1e-3)}
    assert {step: value for (_, step), value in taken.reports.items()} == pytest.approx(reports, rel=1e-3)
    alone, together = (policy_of(each, algo) for each in (tmp_path / "alone", folder))
    assert alone.keys() == together.keys()
    for name, value in alone.items():
        np.testing.assert_allclose(together[name], value, atol=1e-3, err_msg=name)
    models = [ALGOS[algo].load(run_in(each).model_path) for each in (tmp_path / "alone", folder)]
    for name in ("num_timesteps", "_n_updates", "learning_starts", "batch_size", "buffer_size", "policy_delay", "seed"):
        assert len({getattr(model, name) for model in models}) == 1, name
    for name in ("actor", "critic"):
        one, other = (getattr(model, name).optimizer.state_dict() for model in models)
        assert str(one["param_groups"]) == str(other["param_groups"])
        assert one["state"].keys() == other["state"].keys() != set()
        for key, moments in one["state"].items():
            assert moments["step"] == other["state"][key]["step"]
            np.testing.assert_allclose(other["state"][key]["exp_avg"], moments["exp_avg"], atol=1e-2)
    files = [{path.relative_to(each) for path in each.rglob("*")} for each in (tmp_path / "alone", folder)]
    # States are removed with the population's; no best model is kept
    assert {str(path).partition("/")[0] for path in files[0] - files[1]} <= {"best_model.zip", "state", ".run-lock"}
    assert files[1] <= files[0]
    assert read_curve(folder).timesteps == read_curve(tmp_path / "alone").timesteps


def rows(folder):
    """The episodes of a monitor, without times."""
    return [line.split(",")[:2] for line in (folder / "0.monitor.csv").read_text().splitlines()[1:]]


@pytest.mark.parametrize(
    "methods",
    [
        {"A": ("cgp", CEM), "B": ("cgp", CEM | dict(learning_rate=0.01, gamma=0.9))},
        {"A": ("td3", NOISE), "B": ("td3", NOISE | dict(noise_std=0.5, tau=0.1))},
    ],
)
def test_an_interrupted_population_is_an_undisturbed_one(tmp_path, runs_of, methods):
    runs = runs_of(methods, steps=240)
    finals, taken, folders = train_together(runs, tmp_path / "straight")
    again, as_before, others = train_together(runs, tmp_path / "stopped", 70, 215)
    assert len(finals) == 4
    assert again == finals
    assert as_before.reports == taken.reports
    assert sorted(step for _, step in taken.reports) == [step for step in range(40, 241, 40) for _ in runs]
    for run, straight, stopped in zip(runs, folders, others, strict=True):
        for name, value in policy_of(straight, run.algo).items():
            np.testing.assert_array_equal(policy_of(stopped, run.algo)[name], value, err_msg=name)
        assert rows(stopped) == rows(straight)
        assert len(rows(straight)) == 2
        assert list(read_curve(stopped).mean) == [taken.reports[run.key, step] for step in range(40, 241, 40)]
    assert len(set(finals.values())) == 4


def test_a_population_that_was_interrupted_after_its_last_step_has_its_whole_curve(tmp_path, runs_of, monkeypatch):
    runs = runs_of({"A": ("td3", {})})
    finals, taken, _ = train_together(runs, tmp_path / "straight")
    with monkeypatch.context() as patch:
        patch.setattr(population_run, "_finish", lambda *args: interrupt_at(0)(0))
        group, folders = Group.of(tmp_path / "stopped", runs), [tmp_path / run.key for run in runs]
        with pytest.raises(Interruption):
            train_group(group, folders, Taken(), lambda step: None, "cpu")
    continued = Taken()
    assert train_group(group, folders, continued, lambda step: None, "cpu") == finals
    assert continued.reports == taken.reports


def test_a_population_whose_states_are_damaged_begins_anew(tmp_path, runs_of):
    runs = runs_of({"A": ("td3", {})})
    straight = train_together(runs, tmp_path / "straight")
    group, folders = Group.of(tmp_path / "stopped", runs), [tmp_path / run.key for run in runs]
    with pytest.raises(Interruption):
        train_group(group, folders, Taken(), interrupt_at(80), "cpu")
    (manifest,) = group.states.glob("state-*.json")
    manifest.write_text("cut sh")
    anew = Taken()
    assert train_group(group, folders, anew, lambda step: None, "cpu") == straight[0]
    assert anew.reports == straight[1].reports


def test_on_a_gpu_environments_are_in_other_processes_and_the_same(tmp_path, runs_of, monkeypatch):
    runs, made = runs_of({"A": ("td3", NOISE)}, steps=90), []
    finals, taken, folders = train_together(runs, tmp_path / "here")

    def in_processes(makers):
        # SB3's default imports all packages in each process, which takes long
        made.append(ChunkedSubprocVecEnv(makers, n_processes=2, start_method="fork"))
        return made[-1]

    monkeypatch.setattr(population_run, "get_device", lambda device: th.device("cuda"))
    monkeypatch.setattr(population_run, "ChunkedSubprocVecEnv", in_processes)
    again, as_before, others = train_together(runs, tmp_path / "there", 70)
    # To train and to evaluate, before and after the interruption
    assert len(made) == 4
    assert (again, as_before.reports) == (finals, taken.reports)
    assert [rows(each) for each in others] == [rows(each) for each in folders]


# --- In a study ---


def study_of(path, population, logs):
    """Train a sweep in this process, and return its study."""
    sweep = load_sweep(str(path))
    ledger = Ledger(InMemoryStorage(), "tiny")
    ledger.open(sweep, {"experiment": sweep.name})
    execute_runs(ledger, logs, "a process", device="cpu", population=population)
    return ledger


@pytest.mark.filterwarnings("ignore:Agent 1 has failed")
def test_a_run_that_diverges_fails_alone(tmp_path):
    path = write_sweep(
        tmp_path, {"A": ("td3", {}), "B": ("td3", dict(learning_rate=1e30)), "C": ("td3", dict(tau=0.1))}, seeds=1
    )
    records = {record.method: record for record in study_of(path, 8, tmp_path / "logs").records()}
    assert {record.population for record in records.values()} == {3}
    assert "loss was NaN or infinite at gradient step" in records["B"].error
    assert records["B"].error.startswith("ValueError: ")
    assert records["B"].final is None
    for name in ("A", "C"):
        assert (records[name].error, records[name].timesteps) == (None, [40, 80, 120])
        assert np.isfinite(records[name].final)


@pytest.mark.filterwarnings("ignore:Agent . has failed")
def test_runs_that_all_diverge_all_fail(tmp_path):
    path = write_sweep(tmp_path, {"B": ("td3", dict(learning_rate=1e30))})
    ledger = study_of(path, 8, tmp_path / "logs")
    assert ["loss was NaN or infinite at gradient step" in record.error for record in ledger.records()] == [True, True]
    # None was tried again
    assert len(ledger.trials()) == 2


def headings(page):
    return [line for line in page.read_text().splitlines() if line.startswith("#")]


def test_a_sweep_by_populations_has_the_runs_and_the_page_of_one_without(tmp_path):
    path = write_sweep(
        tmp_path, {"T": ("td3", NOISE), "S": ("sac", {})}, axes={"learning_rate": {"values": [0.001, 0.01]}}, steps=80
    )
    sweep, found = load_sweep(str(path)), {}
    for size in (1, 8):
        folder, url = tmp_path / str(size), f"sqlite:///{tmp_path}/{size}.db"
        ledger = Ledger(open_storage(url), "tiny")
        ledger.open(sweep, describe(sweep, ["tiny"], "cpu"))
        execute_runs(ledger, folder / "logs", "a process", device="cpu", population=size)
        exported = export_study("tiny", url, folder / "results")
        page = figures([exported], folder / "results")
        found[size] = ledger.records(), headings(page), [*map(json.loads, (exported / "runs.jsonl").read_text().splitlines())]
    (alone, headings_alone, lines_alone), (together, headings_together, lines_together) = found[1], found[8]
    assert headings_together == headings_alone
    assert {record.key for record in together} == {record.key for record in alone} == {run.key for run in sweep.runs()}
    assert [[*line] for line in lines_together] == [[*line] for line in lines_alone]
    assert [*lines_alone[0]] == [field.name for field in fields(Record)]
    same = ("experiment", "method", "task", "settings", "seed", "steps", "timesteps", "error")
    for one, other in zip(*(sorted(records, key=lambda record: record.key) for records in (alone, together)), strict=True):
        assert [getattr(one, name) for name in same] == [getattr(other, name) for name in same]
        # SAC's are trained alone, and the same
        assert (one.population, other.population) == ((1, 1) if one.method == "S" else (1, 4))
        assert (one.final == other.final) == (one.method == "S")
        assert other.processor_seconds > 0
    paths = [sorted(run.name for run in (tmp_path / size / "logs").glob("tiny/*/*/*")) for size in ("1", "8")]
    assert paths[0] == paths[1]
    assert not list((tmp_path / "8" / "logs" / "tiny" / "populations").iterdir())


@pytest.mark.filterwarnings("ignore:Agent 1 has failed")
@pytest.mark.parametrize("is_removed", [False, True])
def test_the_folder_of_a_run_that_has_failed_remains_as_it_is(tmp_path, monkeypatch, is_removed):
    path = write_sweep(tmp_path, {"A": ("td3", {}), "B": ("td3", dict(learning_rate=1e30))}, seeds=1, steps=430)
    sweep, ledger = load_sweep(str(path)), Ledger(InMemoryStorage(), "tiny")
    ledger.open(sweep, {"experiment": sweep.name})
    report = population_run.PopulationReporter._on_step
    with monkeypatch.context() as patch:
        # The first episode has ended
        stopping = lambda self: report(self) and (self.n_calls < 210 or interrupt_at(0)(0))  # noqa: E731
        patch.setattr(population_run.PopulationReporter, "_on_step", stopping)
        patch.setattr(worker_loop, "MACHINE_ERRORS", Interruption)
        with pytest.raises(Interruption):
            execute_runs(ledger, tmp_path / "logs", "a process", device="cpu", population=8)
    good, failed = ((next((tmp_path / "logs").glob(f"tiny/{name}/td3/*"))) for name in "AB")
    before = (failed / "0.monitor.csv").read_text()
    assert (len(rows(good)), len(rows(failed))) == (2, 1)
    if is_removed:
        shutil.rmtree(failed)
    execute_runs(ledger, tmp_path / "logs", "another process", device="cpu", population=8)
    assert len(rows(good)) == 3
    if not is_removed:
        assert (failed / "0.monitor.csv").read_text() == before
    records = {record.method: record for record in ledger.records()}
    assert records["A"].error is None
    assert records["A"].population == 2


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


def in_processes(monkeypatch):
    """Step environments in other processes, as on a GPU. SB3's default method of starting them takes long."""
    monkeypatch.setattr(population_run, "get_device", lambda device: th.device("cuda"))
    fork = partial(ChunkedSubprocVecEnv, n_processes=2, start_method="fork")
    monkeypatch.setattr(population_run, "ChunkedSubprocVecEnv", fork)


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


def test_a_population_whose_process_is_killed_goes_on_to_the_bit(tmp_path):
    methods = {"A": ("td3", NOISE), "B": ("td3", NOISE | dict(learning_rate=0.01))}
    path = write_sweep(tmp_path, methods, seeds=2, steps=600, evaluation_interval=100, checkpoint_interval=20)
    records = []
    for name, steps in (("straight", []), ("killed", [30, 250])):
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
