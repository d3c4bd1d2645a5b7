"""One run of a sweep: trained by rl_zoo3, reported as it goes, and the same if it was interrupted."""

import numpy as np
import pytest
import yaml
from rl_zoo3 import ALGOS
from rl_zoo3.utils import get_saved_hyperparams
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env
from trainings import Interruption

from benchmark.reporting.run_curves import read_curve
from benchmark.reporting.zoo_runs import run_in
from benchmark.sweeps.experiments import load_sweep
from benchmark.sweeps.random_actions import RandomActions
from benchmark.sweeps.run import forget_states, run_folder, train
from sb3_cgp.resumption.algorithm import ResumableAlgorithm, resumable

pytestmark = pytest.mark.usefixtures("short_episodes")
TINY = dict(learning_starts=20, batch_size=8, buffer_size=400, policy_kwargs="dict(net_arch=[8, 8])")


@pytest.fixture
def run_of(tmp_path):
    """Make the only run of a tiny sweep."""

    def make(algo="td3", task="Pendulum-v1", tuned=False, **hyperparams):
        content = dict(
            title="A sweep",
            methods={"M": {"algo": algo, "hyperparams": {"policy": "MlpPolicy"} | hyperparams, "tuned": tuned}},
            tasks=[task],
            steps=250,
            seeds=[3],
            evaluation_interval=50,
            evaluation_episodes=2,
            checkpoint_interval=30,
        )
        (tmp_path / "mine.yml").write_text(yaml.safe_dump(content))
        (run,) = load_sweep(str(tmp_path / "mine.yml")).runs()
        return run

    return make


def trained(run, folder, *stops):
    """Train a run, interrupting it at the given steps, and return its final return and all that was reported."""
    for stop in [*stops, None]:
        reports = {}

        def watch(step, stop=stop):
            if stop is not None and step >= stop:
                raise Interruption

        try:
            return train(run, folder, reports.__setitem__, watch, "cpu"), reports
        except Interruption:
            assert stop is not None
            np.random.seed(stop)  # noqa: NPY002  # another process has other random numbers


def policy_of(folder, algo):
    return ALGOS[algo].load(run_in(folder).model_path).policy.state_dict()


@pytest.mark.parametrize("algo", ["cgp", "td3", "ddpg", "sac", "tqc", "crossq"])
def test_an_interrupted_run_is_an_undisturbed_one(tmp_path, run_of, algo):
    run = run_of(algo, **TINY)
    final, reports = trained(run, tmp_path / "straight")
    assert (tmp_path / "straight" / "Pendulum-v1.zip").is_file()
    assert trained(run, tmp_path / "stopped", 65, 195) == (final, reports)
    straight, stopped = (policy_of(tmp_path / name, algo) for name in ("straight", "stopped"))
    for name, value in straight.items():
        np.testing.assert_array_equal(stopped[name], value, err_msg=name)


def test_reports_are_the_usual_evaluations(tmp_path, run_of):
    _, reports = trained(run_of(**TINY), tmp_path)
    curve = read_curve(tmp_path)
    assert reports == dict(zip(curve.timesteps, curve.mean, strict=True))
    assert list(reports) == [50, 100, 150, 200, 250]


def test_offline_training_adds_no_points_and_is_scored_at_its_end(tmp_path, run_of, monkeypatch):
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 60)
    final, reports = trained(run_of("cgp", **TINY, policy_training="offline"), tmp_path)
    assert list(reports) == [50, 100, 150, 200, 250]
    model = ALGOS["cgp"].load(run_in(tmp_path).model_path)
    assert model.policy.inference == "actor"
    assert np.isfinite(final)


def test_the_other_scripts_of_rl_zoo3_find_what_they_look_for(tmp_path, run_of):
    run = run_of(**TINY, normalize=True)
    folder = run_folder(tmp_path, "study", run)
    trained(run, folder)
    assert folder == tmp_path / "study" / "M" / "td3" / "Pendulum-v1_4"
    found = run_in(folder)
    assert (found.read_yaml("config.yml")["batch_size"], found.read_yaml("args.yml")["seed"]) == (8, 3)
    hyperparams, stats_path = get_saved_hyperparams(str(found.settings_folder), norm_reward=False)
    assert hyperparams["normalize"]
    assert stats_path == str(found.settings_folder)
    # States are kept until the study knows of the run's end
    assert (folder / "state").exists()
    forget_states(folder)
    assert not (folder / "state").exists()
    assert found.model_path.is_file()


def test_what_is_trained_is_what_the_sweep_says(tmp_path, run_of):
    trained(run_of("sac", **TINY, learning_rate=0.002, gamma=0.9), tmp_path)
    model = ALGOS["sac"].load(run_in(tmp_path).model_path)
    assert (model.learning_rate(1.0), model.gamma, model.batch_size, model.learning_starts) == (0.002, 0.9, 8, 20)
    assert model.num_timesteps == 250


def test_a_tuned_method_starts_from_the_tasks_entry(tmp_path, run_of):
    run = run_of("cgp", tuned=True, **TINY)
    trained(run, tmp_path)
    model = ALGOS["cgp"].load(run_in(tmp_path).model_path)
    assert (model.tau, model.gamma, model.batch_size) == (0.02, 0.98, 8)
    assert model.num_timesteps == 250


def test_algorithms_without_states_start_anew(tmp_path, run_of):
    run = run_of("ppo", n_steps=64, batch_size=32, policy_kwargs="dict(net_arch=[8])")
    final, reports = trained(run, tmp_path / "straight")
    assert trained(run, tmp_path / "stopped", 100) == (final, reports)


def test_random_actions_are_uniform_and_learn_nothing(tmp_path, run_of):
    _, reports = trained(run_of("random"), tmp_path)
    assert len(reports) == 5
    model = RandomActions("MlpPolicy", make_vec_env("Pendulum-v1", n_envs=3, seed=0), seed=0)
    model.learn(300)
    assert model._n_updates == 0
    actions = np.concatenate([model.predict(model.env.reset())[0] for _ in range(700)])
    assert actions.shape == (2100, 1)
    np.testing.assert_allclose(np.histogram(actions, bins=4, range=(-2, 2))[0] / 2100, 0.25, atol=0.04)
    assert model.predict(model.env.reset()[0])[0].shape == (1,)


def test_resumable_changes_nothing_else():
    assert issubclass(resumable(TD3), (TD3, ResumableAlgorithm))
    assert resumable(resumable(TD3)).__name__ == "TD3"
    arguments = dict(learning_starts=10, batch_size=8, policy_kwargs=dict(net_arch=[8]), seed=0)
    plain, with_states = (each("MlpPolicy", "Pendulum-v1", **arguments).learn(60) for each in (TD3, resumable(TD3)))
    for name, value in plain.policy.state_dict().items():
        np.testing.assert_array_equal(with_states.policy.state_dict()[name], value, err_msg=name)


def test_a_run_whose_states_are_all_damaged_begins_anew(tmp_path, run_of):
    run = run_of(**TINY)
    straight = trained(run, tmp_path / "straight")
    with pytest.raises(Interruption):
        train(run, tmp_path / "stopped", lambda step, value: None, interrupt_at(150), "cpu")
    (manifest,) = (tmp_path / "stopped" / "state").glob("state-*.json")
    manifest.write_text("cut sh")
    assert trained(run, tmp_path / "stopped") == straight


def test_callbacks_of_ones_own_are_kept(tmp_path, run_of):
    callback = {
        "stable_baselines3.common.callbacks.CheckpointCallback": {"save_freq": 100, "save_path": str(tmp_path / "own")}
    }
    trained(run_of(**TINY, callback=callback), tmp_path / "run")
    assert len(list((tmp_path / "own").glob("*.zip"))) == 2


@pytest.mark.parametrize("name", ["sb3_cgp.TrainingCheckpointCallback", "sb3_cgp.resumption.TrainingCheckpointCallback"])
@pytest.mark.parametrize("kind", ["list", "mapping", "name"])
def test_states_are_saved_by_one_callback(tmp_path, run_of, name, kind):
    """Also where the entry has one, as a tuning's has."""
    own = {"list": [{name: {"save_freq": 20}}], "mapping": {name: {"save_freq": 20}}, "name": name}[kind]
    with pytest.raises(Interruption):
        train(run_of(**TINY, callback=own), tmp_path / "run", lambda step, value: None, interrupt_at(100), "cpu")
    (entry,) = yaml.safe_load((tmp_path / "run" / "hyperparams.yml").read_text()).values()
    saving = {"sb3_cgp.resumption.callbacks.TrainingCheckpointCallback": {"save_freq": 30, "keep": 1}}
    assert entry["callback"] == [saving]
    assert len(list((tmp_path / "run" / "state").glob("state-*.json"))) == 1


def test_a_run_is_not_taken_up_from_the_states_of_another(tmp_path, run_of):
    """... which a study of the same name has left, in a storage that is gone."""
    with pytest.raises(Interruption):
        train(run_of(**TINY), tmp_path / "used", lambda step, value: None, interrupt_at(100), "cpu")
    run = run_of(**TINY, learning_rate=0.01)
    assert trained(run, tmp_path / "used") == trained(run, tmp_path / "fresh")


def interrupt_at(step):
    def watch(timestep):
        if timestep >= step:
            raise Interruption

    return watch


def test_a_run_that_was_interrupted_after_its_last_step_has_its_whole_curve(tmp_path, run_of, monkeypatch):
    run = run_of("cgp", **TINY, cem_samples=8, cem_elites=2)
    straight = trained(run, tmp_path / "straight")

    def stop(*args):
        raise Interruption

    with monkeypatch.context() as patch:
        patch.setattr("benchmark.sweeps.run._final_return", stop)
        with pytest.raises(Interruption):
            train(run, tmp_path / "stopped", lambda step, value: None, lambda step: None, "cpu")
    assert trained(run, tmp_path / "stopped") == straight


def test_a_tuned_method_goes_on_with_what_the_tasks_entry_says(tmp_path, run_of, monkeypatch):
    """... of normalization, say, which is no argument of the algorithm."""
    entry = {"n_timesteps": 250, "policy": "MlpPolicy", "normalize": True}
    monkeypatch.setattr("sb3_cgp.zoo.registration.hyperparams_folder", lambda: tmp_path)
    (tmp_path / "cgp.yml").write_text(yaml.safe_dump({"Pendulum-v1": entry}))
    run = run_of("cgp", tuned=True, **TINY, cem_samples=8, cem_elites=2)
    straight = trained(run, tmp_path / "straight")
    assert run_in(tmp_path / "straight").read_yaml("config.yml")["normalize"]
    assert trained(run, tmp_path / "stopped", 65, 195) == straight


def test_a_final_return_that_is_no_number_is_a_failure(tmp_path, run_of, monkeypatch):
    # Optuna's databases could not read it again
    monkeypatch.setattr("benchmark.sweeps.run.evaluate_policy", lambda *args, **kwargs: ([1.0, np.nan], [200, 200]))
    with pytest.raises(FloatingPointError, match="mean return is nan"):
        trained(run_of(**TINY), tmp_path)
