"""The files of sweeps: what they say, what follows from them, and what is refused."""

import itertools
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import yaml

from benchmark.common.zoo import read_entry
from benchmark.sweeps.experiments import experiments_in_words, included_sweeps, load_sweep, sweeps_folder
from benchmark.sweeps.processes import share_of_cores, start_workers
from benchmark.sweeps.runs import overview
from benchmark.sweeps.validation import SweepError, read_yaml

ROOT = Path(__file__).parent.parent
PAPER = ["e1", "e3", "e4", "e5", "e6", "e7", "e8"]


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_sweeps_have_each_run_once(name):
    sweep = load_sweep(name)
    keys = Counter(run.key for run in sweep.runs())
    assert set(keys.values()) == {1}
    combinations = list(itertools.product(*(axis.values for axis in sweep.file.axes.values())))
    assert len(keys) == (len(combinations) - len(sweep.file.exclude)) * len(sweep.methods) * 4 * len(sweep.file.tasks)
    assert all((run.steps, run.evaluation_interval) == (1_000_000, 10_000) for run in sweep.runs())


def test_the_papers_sweeps_are_as_many_runs_as_it_has_combinations():
    assert {name: len(load_sweep(name).runs()) for name in PAPER} == {
        # With CGP-Light, which the paper does not have
        "e1": 10 * 5 * 4,
        "e3": 4 * 2 * 3 * 4,
        "e4": 3 * 4 * 4,
        "e5": 4 * 4 * 4,
        "e6": 4 * (3 * 4 - 2) * 4,
        "e7": 2 * 3 * 4,
        "e8": 4 * 2 * 4,
    }
    assert included_sweeps("e2") == ["e4", "e5", "e6", "e7", "e8"]


def test_each_files_name_is_known():
    for path in sweeps_folder().glob("*.yml"):
        if path.name != "methods.yml":
            assert all(load_sweep(name).runs() for name in included_sweeps(path.stem))


def settings_of(name, method):
    """What a method is trained with, by the values of the axes."""
    return {tuple(run.settings.values()): run.hyperparams for run in load_sweep(name).runs() if run.method == method}


def test_all_sources_of_noise_are_varied():
    for method in ("CGP-Online", "TD3"):
        for (value,), hyperparams in settings_of("e4", method).items():
            assert (hyperparams["noise_type"], hyperparams["noise_std"]) == ("normal", value)
            assert hyperparams["target_policy_noise"] == value
    for (value,), hyperparams in settings_of("e4", "DDPG").items():
        assert hyperparams["noise_std"] == value
        assert "target_policy_noise" not in hyperparams


def test_all_networks_have_the_width():
    for method in ("CGP-Online", "DDPG", "TD3", "SAC"):
        for (width,), hyperparams in settings_of("e5", method).items():
            assert eval(hyperparams["policy_kwargs"]) == dict(net_arch=[width, width])


def test_learning_rates_and_batches_leave_the_far_corners_out():
    settings = settings_of("e6", "SAC")
    assert set(itertools.product([1e-2, 1e-3, 1e-4], [256, 128, 64, 32])) - set(settings) == {(1e-4, 256), (1e-2, 32)}
    for (learning_rate, batch_size), hyperparams in settings.items():
        assert (hyperparams["learning_rate"], hyperparams["batch_size"]) == (learning_rate, batch_size)


def test_named_values_set_several_hyperparameters():
    by_name = settings_of("e8", "TD3")
    assert (by_name["step",]["train_freq"], by_name["step",]["gradient_steps"]) == ([1, "step"], 1)
    assert (by_name["episode",]["train_freq"], by_name["episode",]["gradient_steps"]) == ([1, "episode"], -1)


def test_a_value_is_put_in_all_its_places(sweep_of):
    sets = {"policy_kwargs": {"net_arch": ["$value", 8]}, "train_freq": ["$value", "step"], "tau": 0.1}
    sweep = sweep_of(axes={"width": {"values": [4], "sets": sets}}, seeds=1)
    for run in sweep.runs():
        assert run.hyperparams["policy_kwargs"] == {"net_arch": [4, 8]}
        assert (run.hyperparams["train_freq"], run.hyperparams["tau"]) == ([4, "step"], 0.1)


def test_a_mistake_in_the_file_of_methods_is_said_to_be_there(tmp_path, sweep_of):
    (tmp_path / "methods.yml").write_text("TD3: {algo: td3, hyperparams: {gama: 1}}")
    with pytest.raises(SweepError, match=r"methods\.yml: gama: no hyperparameter of TD3"):
        sweep_of(methods=["TD3"])


def test_the_text_of_changes_has_no_tasks_seeds_and_methods():
    sweep = load_sweep("e3", {"tasks": ["Pendulum-v1"], "seeds": 1, "steps": 400, "evaluation_interval": 20}, ["CGP-Online"])
    assert sweep.changes == ["steps 400", "evaluation_interval 20"]
    assert load_sweep("e5", {"hyperparams": {"policy_kwargs": "dict(net_arch=[64, 64])"}}).changes == []


def test_the_documented_sweep_is_one(tmp_path):
    documentation = (Path(__file__).parent.parent / "docs" / "experiments.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", documentation, flags=re.DOTALL)
    (tmp_path / "mine.yml").write_text(example)
    runs = load_sweep(str(tmp_path / "mine.yml")).runs()
    assert len(runs) == 2 * 2 * (3 * 2 - 1) * 3
    samples = {run.hyperparams.get("cem_samples") for run in runs if run.method == "CGP"}
    assert samples == {16, 64, 256}
    assert not any("cem_samples" in run.hyperparams for run in runs if run.method == "TQC")
    rows = dict(re.findall(r"\| `(e\d+)` .*\| (\d+) \|", documentation))
    assert {name: str(sum(len(load_sweep(each).runs()) for each in included_sweeps(name))) for name in rows} == rows


def test_short_runs_learn_too():
    def starts(name, **overrides):
        return {run.hyperparams["learning_starts"] for run in load_sweep(name, overrides).runs()}

    assert starts("e3") == {10_000}
    assert starts("e3", steps=3_000) == {300}
    assert starts("e3", steps=3_000, hyperparams={"learning_starts": 50}) == {50}
    assert starts("e7", steps=3_000) == {0, 1_000, 10_000}


def test_short_runs_learn_with_the_numbers_of_random_steps_that_a_file_does_not_name(tmp_path, sweep_of):
    """10,000 is CGP's default, and the number in rl_zoo3's entry for TD3."""
    tuned = {"algo": "td3", "tuned": True}
    methods = {
        "CGP": {"algo": "cgp", "hyperparams": {"policy": "MlpPolicy"}},
        "TD3": tuned,
        "PPO": {"algo": "ppo", "tuned": True},
    }
    sweep_of(methods=methods, steps=2_000)

    def starts(**overrides):
        return {
            run.method: run.hyperparams.get("learning_starts")
            for run in load_sweep(str(tmp_path / "mine.yml"), overrides).runs()
        }

    assert starts() == {"CGP": 200, "TD3": 200, "PPO": None}
    assert starts(hyperparams={"learning_starts": 1_500}, methods={"CGP": methods["CGP"]}) == {"CGP": 1_500}
    # Long runs have what their algorithm or their entry says
    assert starts(steps=200_000) == {"CGP": None, "TD3": 10_000, "PPO": None}


def test_a_number_of_random_steps_that_is_meant_for_the_length_of_the_runs_is_kept(tmp_path, sweep_of):
    """That which a file gives its own methods, and that of an entry for no more steps than the file's."""
    sweep_of(methods={"A": {"algo": "td3", "hyperparams": {"learning_starts": 60}}}, steps=100)
    kept, shortened = (load_sweep(str(tmp_path / "mine.yml"), dict(steps=steps)) for steps in (None, 99))
    assert {run.hyperparams["learning_starts"] for run in kept.runs()} == {60}
    assert {run.hyperparams["learning_starts"] for run in shortened.runs()} == {9}
    assert (kept.shortened_warm_up(), shortened.shortened_warm_up()) == ({}, {"learning_starts": 9})
    fixed = load_sweep(str(tmp_path / "mine.yml"), dict(steps=99, hyperparams={"learning_starts": 50}))
    assert fixed.shortened_warm_up() == {}

    entry = read_entry("cgp", "Pendulum-v1")
    assert entry["learning_starts"] > entry["n_timesteps"] // 10
    for steps, expected in (
        (int(entry["n_timesteps"]), entry["learning_starts"]),
        (int(entry["n_timesteps"]) - 10, entry["n_timesteps"] // 10 - 1),
    ):
        sweep = sweep_of(methods={"CGP": {"algo": "cgp", "tuned": True}}, steps=steps)
        assert {run.hyperparams.get("learning_starts") for run in sweep.runs()} == {expected}


def test_a_wrong_file_is_left_out_of_the_list(tmp_path, monkeypatch):
    files = {
        "a": "{title: A, steps: 3000}",
        "b": "{title: B, includes: [a, e1]}",
        "c": "{title: C, steps: 1.0e+6}",
        "broken": "{",
        "no-title": "{steps: 10}",
        "no-steps": "{title: C}",
        "text": "{title: C, steps: many}",
        "one": "{title: C, includes: 7}",
        "list": "[1]",
    }
    for name, content in files.items():
        (tmp_path / f"{name}.yml").write_text(content)
    monkeypatch.setattr("benchmark.common.sweep_names.sweeps_folder", lambda: tmp_path)
    assert [line.split() for line in experiments_in_words().splitlines()] == [
        ["sweeps:"],
        ["a", "A,", "3,000", "steps"],
        ["b", "B", "=", "a,", "e1"],
        ["c", "C,", "1,000,000", "steps"],
    ]


def test_methods_of_ones_own(sweep_of):
    sweep = sweep_of(methods={"mine": {"algo": "ppo", "hyperparams": {"n_steps": 64}, "tuned": True}})
    assert {(run.method, run.algo) for run in sweep.runs()} == {("mine", "ppo")}


def test_runs_of_tuned_methods_have_the_tasks_entries_once_and_for_all(sweep_of, tmp_path, monkeypatch):
    """All but the steps, which are the sweep's, and the callback that saves states, in whose place the sweep has its own."""
    monkeypatch.setattr("sb3_cgp.zoo.registration.hyperparams_folder", lambda: tmp_path)
    entries = {task: {"n_timesteps": 9.0, "policy": "MlpPolicy", "gamma": gamma, "tau": 0.1, "callback": "module.Callback"}
               for task, gamma in (("Pendulum-v1", 0.5), ("Reacher-v5", 0.6))}  # fmt: skip
    (tmp_path / "cgp.yml").write_text(yaml.safe_dump(entries))
    methods = {"CGP": {"algo": "cgp", "tuned": True, "hyperparams": {"tau": 0.2}}, "Own": {"algo": "cgp"}}
    sweep = sweep_of(methods=methods, tasks=list(entries), seeds=1, hyperparams={"learning_starts": 1})
    before = sweep.runs()
    expected = {"policy": "MlpPolicy", "tau": 0.2, "learning_starts": 1}
    assert [run.hyperparams for run in before if run.method == "CGP"] == [expected | {"gamma": gamma} for gamma in (0.5, 0.6)]
    assert [run.hyperparams for run in before if run.method == "Own"] == [{"learning_starts": 1}] * 2
    names = {"CGP,Pendulum-v1": 0.5, "CGP,Reacher-v5": 0.6, "Own": None}
    described = overview(before, methods, entries)["configurations"]
    assert {name: entry.get("gamma") for name, entry in described.items()} == names
    (tmp_path / "cgp.yml").write_text("{}")
    assert sweep.runs() == before
    with pytest.raises(SweepError, match=r"mine\.yml: methods: `tuned: true` needs an entry: .*Pendulum-v1"):
        sweep_of(methods=methods)


def test_a_subset_of_seeds_and_a_checkpoint_interval(sweep_of):
    sweep = sweep_of(seeds=[3, 5], checkpoint_interval=25)
    assert {(run.seed, run.checkpoint_interval) for run in sweep.runs()} == {(3, 25), (5, 25)}
    assert {run.checkpoint_interval for run in load_sweep("e3").runs()} == {10_000}


@pytest.mark.parametrize(
    ("changes", "key", "allowed"),
    [
        (dict(tasks=["Pendulum-v7"]), "tasks", "such as Pendulum-v1"),
        (dict(steps=0), "steps", "greater than 0"),
        (dict(steps=None), "steps", "required"),
        (dict(seeds=[-1]), "seeds", "greater than or equal to 0"),
        (dict(stepz=3), "stepz", "must be one of title, methods"),
        (dict(methods=["TD4"]), "methods", "must be one of CGP-Online"),
        (dict(methods={"A": {"algo": "td4"}}), "methods.A", "must be one of a2c"),
        (dict(axes={"gamma": {"values": []}}), "axes.gamma.values", "at least 1"),
        (dict(axes={"gamma": {"values": [0.5, 0.5]}}), "axes.gamma", "differ"),
        (dict(axes={"gamma": {"values": [0.5, "0.5"]}}), "axes.gamma", "differ"),
        (
            dict(axes={"gamma": {"values": [1], "sets": {"gamma": ["$width"]}}}),
            "axes.gamma",
            "only $value stands for something",
        ),
        (dict(seeds=[1, 1]), "mine.yml: seeds: ", "must differ"),
        (dict(axes={"method": {"values": [1], "sets": {}}}), "method", "choose another name"),
        (dict(axes={"task": {"values": [1], "sets": {}}}), "task", "choose another name"),
        (dict(axes={"seed": {"values": [1], "sets": {}}}), "seed", "choose another name"),
        (dict(tasks=["Pendulum-v1"] * 2), "tasks", "must differ"),
        (dict(evaluation_interval=101), "evaluation_interval", "at most `steps`, 100"),
        (dict(hyperparams={"n_timesteps": 50}), "n_timesteps", "must be one of"),
        (dict(methods={"A": {"algo": "td3", "hyperparams": {"learning_starts": "1e2"}}}), "methods.A", "must be a number"),
        (dict(axes={"gamma": {"values": {"a": {}}, "sets": {}}}), "axes.gamma", "for a list of values"),
        (dict(axes={"x": {"values": [1], "sets_for": {"SAC": {}}}}), "SAC", "one of ['TD3', 'CGP-Online']"),
        (dict(exclude=[{"gamma": 1}]), "gamma", "must name one of"),
        (dict(axes={"gamma": {"values": [0.5]}}, exclude=[{"gamma": 1}]), "gamma", "must have one of [0.5]"),
        (dict(hyperparams={"learning_rte": 1}), "learning_rte", "learning_rate"),
        (dict(axes={"learning_rate": {"values": ["1e-3"]}}), "learning_rate", "'1e-3' of TD3 (td3) is text in YAML"),
        (dict(axes={"learning_rate": {"values": ["1e-5"]}}), "learning_rate", "must be a number: write 1.0e-05"),
        (dict(hyperparams={"tau": "0.01"}), "tau", "'0.01' of TD3 (td3) is text in YAML"),
        (dict(hyperparams={"policy_kwargs": {"net_arch": [64, "64"]}}), "policy_kwargs", "'64' of TD3 (td3) is text in YAML"),
        (dict(axes={"a": {"values": {"low": {"gamma": "9e-1"}}}}), "gamma", "'9e-1' of TD3 (td3) is text in YAML"),
        (
            dict(methods={"A": {"algo": "sac", "hyperparams": {"gamma": "high"}}}),
            "gamma",
            "'high' of A (sac) must be a number",
        ),
        (dict(axes={"cem_samples": {"values": [8]}}), "cem_samples", "of TD3"),
        (dict(hyperparams={"learning_rate": "cos_1e-3"}), "learning_rate", "or a linear schedule, such as lin_0.001"),
        (dict(methods={"A": {"algo": "ppo", "hyperparams": {"clip_range_vf": "const_0.1"}}}), "clip_range_vf", "lin_0.001"),
        (dict(axes={"gamma": {"values": [0.5]}}, exclude=[{"gamma": 0.5}]), "exclude", "leaves no combination"),
        (dict(seeds="0-3"), "seeds", "must be a number of seeds, or a list of seeds, such as [0, 1, 2, 3]"),
        (dict(axes={"a": {"values": {True: {}}}}), "axes.a.values", "it is True, as YAML reads it: write it in quotes"),
        (dict(title="A\nsweep"), "'A\\nsweep'", "must be a name of one line"),
        (dict(methods={"A\n": {"algo": "td3"}}), "'A\\n'", "must be a name of one line"),
        (dict(axes={"x\t": {"values": [1], "sets": {}}}), "'x\\t'", "must be a name of one line"),
        (dict(axes={"gamma": {"values": ["a\nb"]}}), "'a\\nb'", "must be a name of one line"),
        (dict(axes={"a": {"values": {"b\r": {}}}}), "'b\\r'", "must be a name of one line"),
        (dict(axes={"a": {"values": {32: {}}}}), "axes.a.values", "it is 32, as YAML reads it: write it in quotes"),
    ],
)
def test_a_mistake_is_named_with_what_is_allowed(tmp_path, sweep_of, changes, key, allowed):
    with pytest.raises(SweepError) as error:
        sweep_of(**changes)
    assert all(part in str(error.value) for part in (str(tmp_path / "mine.yml"), key, allowed)), str(error.value)


def test_text_that_looks_like_a_number_is_left_to_other_code(sweep_of):
    sweep = sweep_of(hyperparams={"env_kwargs": {"version": "2"}, "env_wrapper": [{"my.Wrapper": {"name": "1e3"}}]}, seeds=1)
    assert all(run.hyperparams["env_kwargs"] == {"version": "2"} for run in sweep.runs())


def test_no_sweep_of_that_name():
    with pytest.raises(SweepError, match="must be one of e1, e2"):
        load_sweep("e9")


@pytest.mark.parametrize("name", ["e9", "e33", "methods", "mine.yml"])
def test_a_misspelt_sweep_is_refused_before_anything_slow_is_imported(name):
    command = [sys.executable, "-X", "importtime", "-m", "benchmark.sweep", name, "--steps", "100"]
    found = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert found.returncode == 1
    assert f"Error: {name}: no such sweep: must be one of e1, e2, e3, e4, e5, e6, e7, e8, e10, " in found.stderr
    assert "import time:" in found.stderr
    assert all(slow not in found.stderr for slow in ("torch", "stable_baselines3", "optuna", "matplotlib"))


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="a process may use all cores")
def test_threads_are_the_share_of_the_cores_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    assert [share_of_cores(number) for number in (1, 4, 7)] == [6, 1, 1]


def test_processes_that_start_are_announced_with_their_logs(tmp_path, capsys):
    for worker in start_workers([sys.executable, "-c", ""], 2, 1, tmp_path):
        assert worker.wait() == 0
    assert capsys.readouterr().err == f"Starting 2 workers, whose logs are {tmp_path}/worker-*.log\n"
    start_workers([sys.executable, "-c", ""], 0, 1, tmp_path)
    assert capsys.readouterr().err == ""


def test_what_the_command_line_changes_is_checked_too():
    with pytest.raises(SweepError, match="the command line: steps"):
        load_sweep("e1", {"steps": 0})
    with pytest.raises(SweepError, match="'PPO' must be one of CGP-Online"):
        load_sweep("e1", methods=["PPO"])


def test_a_file_that_is_no_mapping(tmp_path):
    (tmp_path / "mine.yml").write_text("- a")
    with pytest.raises(SweepError, match="mapping"):
        load_sweep(str(tmp_path / "mine.yml"))
    (tmp_path / "mine.yml").write_text("a: [")
    with pytest.raises(SweepError, match="cannot be read"):
        load_sweep(str(tmp_path / "mine.yml"))
    (tmp_path / "mine.yml").write_bytes(b"title: caf\xe9")
    with pytest.raises(SweepError, match=r"mine\.yml: cannot be read: 'utf-8' codec can't decode byte 0xe9"):
        load_sweep(str(tmp_path / "mine.yml"))


@pytest.mark.parametrize("text", ["title: A\nseeds: 1\nseeds: 2\n", "methods:\n  A: {algo: td3}\n  A: {algo: sac}\n"])
def test_a_key_that_is_given_twice_is_refused(tmp_path, text):
    (tmp_path / "mine.yml").write_text(text)
    with pytest.raises(SweepError, match=r"cannot be read: the key '(seeds|A)' is given twice\n.*line 3"):
        load_sweep(str(tmp_path / "mine.yml"))


def test_a_key_that_replaces_a_merged_one_is_given_once(tmp_path):
    (tmp_path / "mine.yml").write_text("deep: {a: &a {x: 1}, b: &b {<<: *a, x: 2}}\ntop: {<<: *b, x: 3}\n")
    assert read_yaml(tmp_path / "mine.yml")["top"] == {"x": 3}


def test_a_file_with_the_name_of_one_of_the_projects_sweeps_is_warned_of(tmp_path, capsys):
    for name, warns in (("mine", False), ("e1", True), ("e12-lr", True)):
        path = tmp_path / f"{name}.yml"
        path.write_text((sweeps_folder() / "e1.yml").read_text())
        load_sweep(str(path))
        assert ("count as data on the paper's claims" in capsys.readouterr().err) == warns
    load_sweep("e1")
    assert "claims" not in capsys.readouterr().err
