"""A study's settings: with which it is opened again, and how trials show them."""

import json

import pytest
from ledgers import look_for, open_ledger, trials_of
from optuna.storages import InMemoryStorage, RDBStorage
from optuna.trial import TrialState
from studies import GRACE, Clock, make_sweep
from tunings import arguments, tuner_of

from benchmark import tune, worker
from benchmark.sweeps.experiments import Sweep
from benchmark.sweeps.groups import GROUP_RUNS, Group
from benchmark.sweeps.studies import Ledger
from benchmark.sweeps.study_trials import KEY, RUN
from benchmark.sweeps.sweep_files import SweepFile
from benchmark.sweeps.validation import SweepError
from benchmark.sweeps.worker_loop import forget_ended


def test_a_study_is_not_opened_with_other_settings(ledger):
    with pytest.raises(SweepError, match=r"'study': steps: was 100 and is now 200 for Good.*--study"):
        open_ledger(ledger.storage, Clock(), steps=200)
    with pytest.raises(SweepError, match=r"'study': has other methods, tasks or axes.*--study"):
        open_ledger(ledger.storage, Clock(), tasks=["Reacher-v5"])
    assert len(ledger.trials()) == 3
    assert {trial.user_attrs["run"]["steps"] for trial in ledger.trials()} == {100}


def test_further_seeds_and_methods_have_the_hyperparameters_of_the_first(ledger):
    # Of the same configuration, though none of these runs is in the study
    with pytest.raises(SweepError, match=r"'study': hyperparams: was .* and is now .*'gamma': 0\.5.* for Good.*--study"):
        open_ledger(ledger.storage, Clock(), seeds=[3, 4], hyperparams={"gamma": 0.5})
    assert len(ledger.trials()) == 3
    open_ledger(ledger.storage, Clock(), seeds=4)
    assert len(ledger.trials()) == 4


AXIS = {"noise": {"values": [0.1], "sets": {"noise_std": "$value"}}}


@pytest.mark.parametrize(
    ("before", "now", "message"),
    [
        ({}, dict(hyperparams={"gamma": 0.5}), r"hyperparams\.gamma: was 'not given' and is now 0\.5"),
        (dict(hyperparams={"gamma": 0.5}), {}, r"hyperparams\.gamma: was 0\.5 and is now 'not given'"),
        (dict(hyperparams={"a": 1, "b": "x; y"}), dict(hyperparams={"a": 1, "b": "x; z"}), "hyperparams.b: was 'x; y' .*x; z"),
        (dict(axes=AXIS), dict(axes={"noise": AXIS["noise"] | {"sets": {"tau": "$value"}}}), r"axes\.noise: was .*noise.*tau"),
        (
            dict(axes={"noise": {"values": {"some": {"gamma": 0.5}}}}),
            dict(axes={"noise": {"values": {"some": {"gamma": 0.6}}}}),
            r"axes\.noise: was .*0\.5.* and is now .*0\.6",
        ),
    ],
)  # fmt: skip
def test_further_methods_have_what_all_methods_have_in_common(before, now, message):
    """Though no run of theirs is in the study, with which they could be compared."""
    storage = InMemoryStorage()
    ledger = open_ledger(storage, Clock(), **before)
    n_trials = len(ledger.trials())
    with pytest.raises(SweepError, match=f"'study': {message}.*--study"):
        open_ledger(storage, Clock(), methods=["Other"], **now)
    assert len(ledger.trials()) == n_trials
    open_ledger(storage, Clock(), methods=["Other"], **before)
    assert len(ledger.trials()) == 2 * n_trials


def test_a_hyperparameter_that_an_axis_replaces_everywhere_may_be_left_out():
    storage = InMemoryStorage()
    ledger = open_ledger(storage, Clock(), axes=AXIS, hyperparams={"noise_std": 0.5})
    open_ledger(storage, Clock(), axes=AXIS, methods=["Other"])
    assert {trial.user_attrs["run"]["hyperparams"]["noise_std"] for trial in ledger.trials()} == {0.1}


def test_a_study_of_an_earlier_version_gets_further_methods():
    storage = InMemoryStorage()
    ledger = Ledger(storage, "study")
    ledger.open(make_sweep(["Good"]), {"experiment": "tiny"})
    open_ledger(storage, Clock(), methods=["Other"], seeds=2)
    assert len(ledger.trials()) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: run | {"tuned": False}, "unexpected keyword argument 'tuned'"),
        (lambda run: {name: value for name, value in run.items() if name != "steps"}, "missing 1 .* argument: 'steps'"),
    ],
    ids=["more", "fewer"],
)
def test_runs_that_another_version_described_are_refused_in_words(change, message, tmp_path, capsys):
    url = f"sqlite:///{tmp_path}/studies.db"
    storage = RDBStorage(url)
    ledger = open_ledger(storage, Clock())
    for trial in ledger.trials():
        storage.set_trial_user_attr(trial._trial_id, RUN, change(trial.user_attrs[RUN]))
    message = rf"Trial 0 of the study: holds a run of another version of sb3-cgp \(.*{message}.*--study"
    for read in (lambda: open_ledger(storage, Clock()), ledger.recover, ledger.description, lambda: ledger.claim("worker")):
        with pytest.raises(SweepError, match=message):
            read()
    with pytest.raises(SystemExit, match=f"Error: {message}"):
        worker.main(["--study", "study", "--storage", url, "--logs", str(tmp_path)])


def test_a_population_that_another_version_described_is_refused_and_left_alone(ledger, tmp_path):
    group = Group.of(tmp_path / ledger.name, make_sweep(["Good"]).runs())
    group.write()
    assert Group.read(group.folder) == group
    described = json.loads((group.folder / GROUP_RUNS).read_text())
    described[0]["tuned"] = False
    (group.folder / GROUP_RUNS).write_text(json.dumps(described))
    with pytest.raises(SweepError, match=rf"{GROUP_RUNS}: holds a run of another version of sb3-cgp .*'tuned'"):
        Group.read(group.folder)
    # A study of the same name, begun anew
    forget_ended(ledger, tmp_path)
    assert (group.folder / GROUP_RUNS).exists()


def test_an_entry_that_is_edited_in_between_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_cgp.zoo.registration.hyperparams_folder", lambda: tmp_path)
    methods = {"Good": {"algo": "cgp", "tuned": True}}

    def sweep(gamma, seeds):
        (tmp_path / "cgp.yml").write_text(f"Pendulum-v1: {{n_timesteps: 100, policy: MlpPolicy, gamma: {gamma}}}")
        content = dict(title="A test", methods=methods, tasks=["Pendulum-v1"], steps=100, seeds=seeds, evaluation_interval=50)
        file = SweepFile.model_validate(content)
        return Sweep("tiny", file, file.methods)

    ledger = Ledger(InMemoryStorage(), "study")
    ledger.open(sweep(0.5, 1), {"experiment": "tiny"})
    with pytest.raises(SweepError, match=r"'study': hyperparams: was .*'gamma': 0\.5.* and is now .*'gamma': 0\.6"):
        ledger.open(sweep(0.6, 2), {"experiment": "tiny"})
    ledger.open(sweep(0.5, 2), {"experiment": "tiny"})
    assert {trial.user_attrs["run"]["hyperparams"]["gamma"] for trial in ledger.trials()} == {0.5}


def test_a_sweep_and_a_tuning_do_not_share_a_study(ledger):
    storage = ledger.storage
    before = [(trial.state, trial.user_attrs) for trial in trials_of(storage)]
    with pytest.raises(SweepError, match=r"'study': holds the trials of a sweep, or of another program\. .*--study"):
        tuner_of(tune.parse(arguments()), storage)
    assert [(trial.state, trial.user_attrs) for trial in trials_of(storage)] == before

    other = InMemoryStorage()
    tuner_of(tune.parse(arguments()), other)
    with pytest.raises(SweepError, match=r"'study': holds the trials of a tuning\. .*--study"):
        open_ledger(other, Clock())
    assert trials_of(other) == []
    # The same tuning goes on
    tuner_of(tune.parse(arguments()), other)


def test_a_study_may_get_more_seeds_and_more_of_its_methods(ledger):
    open_ledger(ledger.storage, Clock())
    assert len(ledger.trials()) == 3
    open_ledger(ledger.storage, Clock(), seeds=5)
    assert [trial.user_attrs["run"]["seed"] for trial in ledger.trials()] == [0, 1, 2, 3, 4]
    open_ledger(ledger.storage, Clock(), methods=["Other"], seeds=[7])
    assert ledger.trials()[-1].user_attrs[KEY] == "Other,Pendulum-v1,seed=7"


def test_a_trial_shows_its_name_and_its_seed_and_the_seed_is_no_parameter(ledger):
    """optuna-dashboard shows attributes as columns, sorts by numbers, and takes parameters alone for its importances."""
    assert [set(trial.params) for trial in ledger.trials()] == [{"method", "task"}] * 3
    assert [trial.user_attrs["seed"] for trial in ledger.trials()] == [0, 1, 2]
    assert ledger.trials()[0].user_attrs[KEY] == "Good,Pendulum-v1,seed=0"


def test_hyperparameters_that_json_changes_are_the_same(ledger):
    sweep = dict(hyperparams={"policy_kwargs": {1: (2, 3)}}, seeds=1)
    storage = InMemoryStorage()
    open_ledger(storage, Clock(), **sweep)
    rdb = RDBStorage("sqlite:///:memory:")
    open_ledger(rdb, Clock(), **sweep)
    open_ledger(rdb, Clock(), **sweep)
    assert len(trials_of(rdb)) == 1


def test_trials_of_others_are_left_alone(ledger):
    ledger.storage.create_new_trial(ledger.study_id)
    assert len(ledger.trials()) == 3
    look_for(ledger, GRACE + 5)
    assert trials_of(ledger.storage)[-1].state is TrialState.RUNNING
