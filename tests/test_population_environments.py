"""Environments of a population in a few processes: they return what a ``DummyVecEnv`` returns, to the bit."""

import multiprocessing

import gymnasium as gym
import numpy as np
import pytest
from environment_states import assert_same, environment_state, obstacles
from environments import Doubles
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_cgp import RestorableEnv, TrainingCheckpointCallback
from sb3_cgp.population import ChunkedSubprocVecEnv, Population, make_population_env, processes
from sb3_cgp.population.processes import chunk_bounds
from sb3_cgp.resumption.environments import restore_environment

# A forked process starts at once; the tests use no threads
FORK = dict(start_method="fork")


class Short(gym.Wrapper):
    """Ends episodes by a timeout after four steps, and has infos and a state of its own."""

    steps = 0

    def reset(self, **kwargs):
        self.steps = 0
        observation, info = self.env.reset(**kwargs)
        return observation, info | {"start": float(observation[0])}

    def step(self, action):
        self.steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or self.steps == 4, info | {"steps": self.steps}

    def get_training_state(self):
        return {"steps": self.steps}

    def set_training_state(self, state):
        self.steps = state["steps"]


def make(n_envs=5, n_processes=2, seed=3, **kwargs):
    return make_population_env("Pendulum-v1", n_envs, n_processes, seed, wrapper_class=Short, **FORK, **kwargs)


def reference(n_envs=5, seed=3):
    return make_vec_env("Pendulum-v1", n_envs, seed, wrapper_class=lambda env: RestorableEnv(Short(env)))


@pytest.fixture
def closing():
    """Close the environments that a test makes."""
    made = []
    yield lambda env: made.append(env) or env
    for env in made:
        env.close()


def without_times(infos):
    """Drop the wall-clock time of SB3's ``Monitor``."""
    return [
        {key: {name: each[name] for name in "rl"} if key == "episode" else each for key, each in info.items()}
        for info in infos
    ]


def assert_alike_for(ours, theirs, steps, knows_resets=True):
    generator = np.random.default_rng(0)
    for _ in range(steps):
        actions = generator.uniform(-2, 2, (theirs.num_envs, 1)).astype(np.float32)
        (*our_step, our_infos), (*their_step, their_infos) = ours.step(actions), theirs.step(actions)
        assert_same(our_step, their_step)
        assert_same(without_times(our_infos), without_times(their_infos))
        if knows_resets:
            assert_same(list(ours.reset_infos), theirs.reset_infos)


@pytest.mark.parametrize("n_processes", [2, 5])
def test_steps_are_those_of_a_dummy_vec_env_to_the_bit(n_processes, closing):
    ours, theirs = closing(make(n_processes=n_processes)), reference()
    assert isinstance(ours, SubprocVecEnv)
    assert len(ours.processes) == n_processes
    assert (ours.observation_space, ours.action_space, ours.num_envs) == (theirs.observation_space, theirs.action_space, 5)
    assert_same(ours.reset(), theirs.reset())
    assert_same(list(ours.reset_infos), theirs.reset_infos)
    # Episodes end within them
    assert_alike_for(ours, theirs, 10)
    # Without a seed, and with another one
    assert_same(ours.reset(), theirs.reset())
    assert ours.seed(11) == theirs.seed(11)
    assert_same(ours.reset(), theirs.reset())


def test_the_methods_of_a_vec_env_reach_the_right_environments(closing):
    ours, theirs = closing(make()), reference()
    for env in (ours, theirs):
        env.reset()
        env.set_attr("mark", "third", indices=2)
        env.set_attr("mark", "others", indices=[4, 0])
        env.set_attr("mark", "rest", indices=[1, 3])
    assert ours.get_attr("mark") == theirs.get_attr("mark") == ["others", "rest", "third", "rest", "others"]
    assert ours.get_attr("mark", indices=[4, 2, 4]) == theirs.get_attr("mark", indices=[4, 2, 4])
    assert ours.get_attr("mark", indices=-3) == theirs.get_attr("mark", indices=-3) == ["third"]
    states = ours.env_method("get_wrapper_attr", "state", indices=[3, 1])
    assert_same(states, theirs.env_method("get_wrapper_attr", "state", indices=[3, 1]))
    assert ours.env_is_wrapped(Monitor) == [True] * 5
    assert ours.env_is_wrapped(SubprocVecEnv, indices=[1]) == [False]
    assert ours.has_attr("mark")
    assert not ours.has_attr("no_such_attribute")


@pytest.mark.parametrize("indices", [5, -6, [0, 7], np.array([-9])])
def test_indices_out_of_range_are_refused_as_by_a_dummy_vec_env(indices, closing):
    for env in (reference(), closing(make())):
        for call in (
            lambda env: env.get_attr("spec", indices),
            lambda env: env.set_attr("mark", "wrong", indices),
            lambda env: env.env_method("get_wrapper_attr", "spec", indices=indices),
            lambda env: env.env_is_wrapped(Monitor, indices),
        ):
            with pytest.raises(IndexError):
                call(env)
        # No environment was changed, and no answer is left unread
        assert not env.has_attr("mark")
    with pytest.raises(IndexError, match=r"`indices` is .*, but must be indices of the 5 environments, from -5 to 4"):
        env.get_attr("spec", indices)


class Named(Doubles):
    """Observations by name."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Dict({"here": self.observation_space})

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        return {"here": observation}, info

    def step(self, action):
        observation, *rest = super().step(action)
        return {"here": observation}, *rest


def test_observations_by_key_are_joined(closing):
    ours, theirs = closing(ChunkedSubprocVecEnv([Named] * 3, 2, "fork")), DummyVecEnv([Named] * 3)
    for env in (ours, theirs):
        env.seed(5)
    assert_same(dict(ours.reset()), dict(theirs.reset()))
    actions = np.zeros((3, *theirs.action_space.shape), theirs.action_space.dtype)
    assert_same(dict(ours.step(actions)[0]), dict(theirs.step(actions)[0]))


@pytest.mark.parametrize(("n_envs", "n_processes"), [(5, 2), (7, 3), (4, 4), (9, 1)])
def test_environments_are_shared_out_evenly_and_in_order(n_envs, n_processes):
    bounds = chunk_bounds(n_envs, n_processes)
    assert [index for start, stop in bounds for index in range(start, stop)] == list(range(n_envs))
    sizes = [stop - start for start, stop in bounds]
    assert len(sizes) == n_processes
    assert max(sizes) - min(sizes) <= 1


def test_one_process_is_a_dummy_vec_env_and_the_cores_are_the_default(monkeypatch, closing):
    assert type(make(n_processes=1)) is DummyVecEnv
    for cores, expected in ((1, DummyVecEnv), (2, ChunkedSubprocVecEnv)):
        monkeypatch.setattr(processes, "available_cores", lambda cores=cores: cores)
        env = closing(make(n_processes=None, n_envs=3))
        assert type(env) is expected
        assert len(getattr(env, "processes", [0])) == cores


@pytest.mark.parametrize("n_processes", [0, 6, 1.5])
def test_numbers_of_processes_that_do_not_fit_are_refused_by_name(n_processes):
    for refused in (make, lambda n_processes: ChunkedSubprocVecEnv([Doubles] * 5, n_processes)):
        with pytest.raises(ValueError, match="n_processes"):
            refused(n_processes=n_processes)


def test_arguments_that_do_not_fit_are_refused_by_name():
    for n_processes in (1, 2):
        for arguments in (dict(vec_env_cls=SubprocVecEnv), dict(vec_env_kwargs={})):
            (name,) = arguments
            with pytest.raises(ValueError, match=f"`{name}` .* but must be left out: `n_processes` chooses the class"):
                make(n_processes=n_processes, **arguments)
        with pytest.raises(ValueError, match=r"`start_method` is 'nonsense', but must be one of .*'spawn'"):
            make_population_env("Pendulum-v1", 2, n_processes, start_method="nonsense")
    with pytest.raises(ValueError, match="`start_method` is 'nonsense'"):
        ChunkedSubprocVecEnv([Doubles] * 2, 2, "nonsense")
    with pytest.raises(ValueError, match=r"`env_fns` is \[\], but must be a sequence of at least one function"):
        ChunkedSubprocVecEnv([])


def fail():
    raise ZeroDivisionError


@pytest.mark.parametrize("failing", [0, 2])
def test_a_process_that_ends_before_its_environments_are_made_is_named(failing, capfd):
    makers = [Doubles] * 4
    makers[failing] = fail
    message = (
        rf"Process {failing // 2} of 2 ended with exit code 1 .* the indices {failing} to {failing + 1}\. .*`n_processes=1`"
    )
    with pytest.raises(RuntimeError, match=message):
        ChunkedSubprocVecEnv(makers, 2, "fork")
    assert "ZeroDivisionError" in capfd.readouterr().err
    assert multiprocessing.active_children() == []


def test_an_unknown_environment_is_named_from_a_process_too(capfd):
    with pytest.raises(RuntimeError, match=r"Process 0 of 2 ended .*raises that error"):
        make_population_env("Pendulm-v1", 2, 2, **FORK)
    assert "Environment `Pendulm` doesn't exist" in capfd.readouterr().err
    with pytest.raises(gym.error.NameNotFound):
        make_population_env("Pendulm-v1", 2, 1)


def test_restored_environments_go_on_to_the_bit(closing):
    first, other = closing(make()), closing(make(seed=9))
    first.reset()
    actions = np.ones((5, 1), np.float32)
    for _ in range(6):
        first.step(actions)
    assert obstacles(first) == []
    restore_environment(other, environment_state(first))
    # As in a SubprocVecEnv, a process does not know the infos of a reset before the state was saved
    assert_alike_for(first, other, 9, knows_resets=False)
    assert_same(first.reset(), other.reset())


def train(env, steps, callback=None):
    population = Population(
        "MlpPolicy", env, 3, seed=0, learning_starts=4, buffer_size=50, batch_size=4, cem_samples=6, cem_elites=2,
        policy_kwargs=dict(net_arch=[8]), device="cpu",
    )  # fmt: skip
    return population.learn(3 * steps, callback=callback)


def parameters(population):
    return [parameter.detach().numpy() for parameter in population.policy.parameters()]


def test_a_population_trains_in_them_as_in_a_dummy_vec_env_and_resumes(tmp_path, closing):
    whole = train(reference(3, 0), 16)
    ours = train(closing(make(3, seed=0)), 16)
    assert_same(parameters(ours), parameters(whole))
    train(closing(make(3, seed=0)), 10, TrainingCheckpointCallback(10, str(tmp_path)))
    resumed = Population.resume(str(tmp_path), closing(make(3, seed=0)))
    assert resumed.num_timesteps == 30
    assert_same(parameters(resumed.learn(3 * 16)), parameters(whole))


class Kill(BaseCallback):
    """Kills a process of the environments in the middle of a training."""

    def _on_step(self):
        if self.n_calls == 6:
            process = self.training_env.processes[1]
            process.kill()
            process.join()
        return True


def test_a_process_that_dies_is_named_and_ends_the_others(closing):
    env = closing(make(3, seed=0))
    with pytest.raises(RuntimeError, match=r"of 2 workers, worker 1 \(process \d+\) was killed by signal 9"):
        train(env, 16, Kill())
    assert not any(process.is_alive() for process in env.processes)
