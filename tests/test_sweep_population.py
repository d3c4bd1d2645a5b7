"""Runs of a sweep that are trained as one population: each has its own record and folder, and continues where it was."""

import random

import numpy as np
import pytest
import torch as th
from rl_zoo3 import ALGOS
from sweep_populations import NOISE, rows, write_sweep
from test_sweep_run import interrupt_at, policy_of, trained
from trainings import Interruption

from benchmark.reporting.run_curves import read_curve
from benchmark.reporting.zoo_runs import run_in
from benchmark.sweeps import population_run
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.groups import Group
from benchmark.sweeps.population_run import train_group
from benchmark.sweeps.run import run_folder
from sb3_cgp.population import ChunkedSubprocVecEnv
from sb3_cgp.zoo.resumed_run import is_finished, read_run

pytestmark = pytest.mark.usefixtures("short_final_evaluation", "short_episodes")

CEM = dict(cem_samples=6, cem_elites=2, cem_dtype="float32")


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


def test_a_run_that_a_population_has_trained_to_its_end_has_ended(tmp_path, runs_of, capsys):
    _, _, folders = train_together(runs_of({"M": ("cgp", CEM)}), tmp_path, 70)
    assert "was interrupted" not in capsys.readouterr().out
    assert [is_finished(each, *read_run(each)) for each in folders] == [True, True]


@pytest.mark.parametrize(
    "methods",
    [
        {"A": ("cgp", CEM), "B": ("cgp", CEM | dict(learning_rate=0.01, gamma=0.9))},
        {"A": ("td3", NOISE), "B": ("td3", NOISE | dict(noise_std=0.5, tau=0.1))},
    ],
)
def test_an_interrupted_population_is_an_undisturbed_one(tmp_path, runs_of, methods):
    runs = runs_of(methods, steps=160)
    finals, taken, folders = train_together(runs, tmp_path / "straight")
    again, as_before, others = train_together(runs, tmp_path / "stopped", 70, 135)
    assert len(finals) == 4
    assert again == finals
    assert as_before.reports == taken.reports
    assert sorted(step for _, step in taken.reports) == [step for step in range(40, 161, 40) for _ in runs]
    for run, straight, stopped in zip(runs, folders, others, strict=True):
        for name, value in policy_of(straight, run.algo).items():
            np.testing.assert_array_equal(policy_of(stopped, run.algo)[name], value, err_msg=name)
        assert rows(stopped) == rows(straight)
        assert len(rows(straight)) == 1 + 6
        assert list(read_curve(stopped).mean) == [taken.reports[run.key, step] for step in range(40, 161, 40)]
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
