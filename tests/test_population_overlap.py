"""Gradient steps that a population takes while its environments take their step."""

import copy
import pickle

import pytest
import torch as th
from populations import AGENTS, VARIANTS, Pushed, make, make_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv
from trainings import Do

from sb3_cgp import TrainingCheckpointCallback
from sb3_cgp.population import Population, make_population_env
from sb3_cgp.population import training as population_training

sample_columns = population_training.sample_columns


def sample_without_newest(buffer, *args):
    """Sample as the usual order does, but as if the newest transition, the last one stored, were not in the buffer."""
    assert not buffer.full
    position, buffer.pos = buffer.pos, max(1, buffer.pos - 1)
    try:
        return sample_columns(buffer, *args)
    finally:
        buffer.pos = position


@pytest.mark.parametrize("arguments", [VARIANTS["CGP"], dict(learning_starts=0), dict(gradient_steps=2), VARIANTS["n-step"]])
def test_it_learns_what_the_usual_order_learns_without_the_newest_transition(arguments, monkeypatch):
    agents = [{key: value for key, value in each.items() if key not in arguments} for each in AGENTS]
    overlapped = make(agents, overlap=True, **arguments).learn(3 * 60)
    monkeypatch.setattr(population_training, "sample_columns", sample_without_newest)
    usual = make(agents, **arguments).learn(3 * 60)
    assert overlapped.num_timesteps == usual.num_timesteps == 3 * 60
    assert list(overlapped._agent_updates) == list(usual._agent_updates)
    assert (overlapped._agent_updates > 30).all()
    for name, value in usual.policy.state_dict().items():
        assert th.equal(overlapped.policy.state_dict()[name], value), name
    monkeypatch.undo()
    different = make(agents, **arguments).learn(3 * 60).policy.state_dict()
    assert any(not th.equal(different[name], value) for name, value in usual.policy.state_dict().items())


class Noting(DummyVecEnv):
    """Environments that note when a step begins and ends."""

    def __init__(self, n_envs):
        super().__init__([Pushed] * n_envs)
        self.notes = []

    def step_async(self, actions):
        self.notes.append("begins")
        super().step_async(actions)

    def step_wait(self):
        self.notes.append("ends")
        return super().step_wait()


@pytest.mark.parametrize(("overlap", "order"), [(True, ["begins", "trains", "ends"]), (False, ["begins", "ends", "trains"])])
def test_gradient_steps_are_taken_while_the_environments_step(overlap, order, monkeypatch):
    env = Noting(2)
    population = make(2, env, overlap=overlap)
    carry_out = population._carry_out
    monkeypatch.setattr(population, "_carry_out", lambda *args: (env.notes.append("trains"), carry_out(*args))[1])
    population.learn(2 * 30)
    # Random actions come first
    assert env.notes == ["begins", "ends"] * 20 + order * 10


def test_an_error_in_a_gradient_step_leaves_the_environments_usable(monkeypatch):
    env = make_population_env("Pendulum-v1", 2, n_processes=1, start_method="fork", seed=0)
    try:
        population = make(2, env, overlap=True)
        with monkeypatch.context() as patch:
            patch.setattr(population, "_carry_out", lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                population.learn(2 * 30)
        population.learn(2 * 30)
        assert population.num_timesteps == 2 * 30
        assert population._n_updates == 1 + 10
    finally:
        env.close()


def test_a_training_that_a_callback_ended_is_followed_by_a_whole_one():
    population = make(2, overlap=True)
    stop = Do(25, lambda: None)
    stop._on_step = lambda: stop.n_calls < 25
    population.learn(2 * 30, stop)
    # As 5 steps had begun; SB3's loop does not train after the last one
    assert population._n_updates == 5
    population.learn(2 * 30)
    assert population._n_updates == 5 + 10


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
def test_a_population_is_copied_within_learn_and_after_it(copied):
    copies = []
    population = make(2, overlap=True)
    population.learn(2 * 30, Do(25, lambda: copies.append(copied(population))))
    copies.append(copied(population))
    assert [each._n_updates for each in copies] == [5, 10]
    before = copy.deepcopy(population.policy.state_dict())
    for each, n_updates in zip(copies, (15, 20), strict=True):
        each.learn(2 * 10, reset_num_timesteps=False)
        assert each._n_updates == n_updates
    # The copies have trained themselves
    assert population._n_updates == 10
    assert all(th.equal(value, before[name]) for name, value in population.policy.state_dict().items())


def test_it_resumes_as_if_it_had_not_stopped(tmp_path):
    def train(folder, **kwargs):
        env = make_vec_env("Pendulum-v1", 2, seed=3)
        return make(2, env, overlap=True).learn(2 * 60, [TrainingCheckpointCallback(20, folder), *kwargs.values()])

    expected = train(tmp_path / "straight")
    with pytest.raises(ZeroDivisionError):
        train(tmp_path / "stopped", stop=Do(47, lambda: 1 / 0))
    resumed = Population.resume(tmp_path / "stopped", make_vec_env("Pendulum-v1", 2))
    assert resumed.overlap
    resumed.learn(2 * 60)
    for name, value in expected.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(overlap=True, gradient_steps=-1), r"`overlap` is True, but must be False unless `train_freq` is 1"),
        (dict(overlap=True, train_freq=2), r"`overlap` is True, but must be False unless `train_freq` is 1"),
        (dict(overlap=True, train_freq=(1, "episode")), r"`overlap`|`train_freq`"),
        (dict(overlap="yes"), r"`overlap` is 'yes', but must be True or False"),
    ],
)
def test_what_cannot_overlap_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(1, make_env(1), **arguments)
