"""A population that is saved, loaded or resumed goes on as if it had not stopped."""

import io

import numpy as np
import pytest
import torch as th
from populations import AGENTS, VARIANTS, assert_alike, make, make_env, saved_and_loaded
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_cgp import CGP, TrainingCheckpointCallback
from sb3_cgp.population import Population


def test_a_population_is_saved_and_loaded(tmp_path):
    population = make(AGENTS).learn(3 * 60)
    loaded = saved_and_loaded(population, tmp_path)
    observations = np.random.default_rng(0).normal(size=(3, 3))
    np.testing.assert_array_equal(loaded.predict(observations)[0], population.predict(observations)[0])
    for index, agent in enumerate(loaded):
        assert_alike(agent, population[index], rtol=0, atol=0)
        assert (agent.gamma, agent.policy_delay) == (population[index].gamma, population[index].policy_delay)
    loaded.learn(3 * 20, reset_num_timesteps=False)
    assert list(loaded._agent_updates) == [60, 58, 60]
    with pytest.raises(ValueError, match="`tau`"):
        Population.load(tmp_path / "population", tau=0.5)
    assert len(Population.load(tmp_path / "population")) == 3


@pytest.mark.filterwarnings("ignore:Nothing is learnt")
def test_the_name_of_an_environment_stands_for_one_of_each_agent(tmp_path):
    checkpoint = TrainingCheckpointCallback(3 * 20, tmp_path / "states")
    population = make(3, env="Pendulum-v1").learn(3 * 25, callback=checkpoint)
    population.save(tmp_path / "population")
    # `name.zip` beside a folder `name`
    (tmp_path / "population").mkdir()
    with open(tmp_path / "population.zip", "rb") as file:
        saved = [tmp_path / "population", io.BytesIO(file.read())]
    loaded = [Population.load(each, env="Pendulum-v1") for each in saved]
    loaded.append(Population.resume(tmp_path / "states", "Pendulum-v1"))
    population.set_env("Pendulum-v1")
    for each in (*loaded, population):
        assert each.env.num_envs == 3
        each.learn(3 * 26, reset_num_timesteps=False)
    # Each agent's environment has the agent's seed
    first = make(3, env="Pendulum-v1").learn(3).replay_buffer.observations[0]
    np.testing.assert_array_equal(loaded[0].replay_buffer.observations[0], first)
    with pytest.raises(ValueError, match=r"`env.num_envs` is 2, but must be 3, as many as agents"):
        population.set_env(make_vec_env("Pendulum-v1", 2))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        Population.load(saved[0], env="MountainCarContinuous-v0")


@pytest.mark.parametrize("opened", [False, True])
def test_a_population_and_an_agent_are_not_loaded_as_each_other(opened, tmp_path):
    population = make(2)
    population.save(tmp_path / "population")
    agent = population[0]
    # An attribute of the user's makes no population
    agent.agents = 3
    agent.save(tmp_path / "agent")

    def saved(name):
        return io.BytesIO((tmp_path / f"{name}.zip").read_bytes()) if opened else tmp_path / name

    with pytest.raises(ValueError, match=r"the file of a population.* must be of CGP, .*`sb3_cgp.population.Population.load"):
        CGP.load(saved("population"), env=make_env(2))
    with pytest.raises(ValueError, match=r"the file of a single agent.* must be of Population, .*`CGP.load\(path\)`"):
        Population.load(saved("agent"), env=make_env(2))
    assert CGP.load(saved("agent")).agents == 3
    assert len(Population.load(saved("population"))) == 2


class Stop(BaseCallback):
    """Stops the training at a step."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        return self.num_timesteps < self.at


@pytest.mark.filterwarnings("ignore:A test_population_saving.Stop was among the callbacks")
@pytest.mark.parametrize("variant", ["CGP", "TD3"])
def test_a_population_resumes_as_if_it_had_not_stopped(variant, tmp_path):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1))
    agents = [own | dict(action_noise=noise) for own in AGENTS]

    def train(folder, *callbacks):
        callbacks = [TrainingCheckpointCallback(3 * 20, folder), *callbacks]
        return make(agents, env="Pendulum-v1", **VARIANTS[variant]).learn(3 * 90, callback=callbacks)

    whole = train(tmp_path / "whole")
    train(tmp_path / "stopped", Stop(3 * 70))
    resumed = Population.resume(tmp_path / "stopped", make_vec_env("Pendulum-v1", 3))
    assert resumed.num_timesteps == 180
    resumed.learn(3 * 90)
    assert list(resumed._agent_updates) == list(whole._agent_updates)
    for name, value in whole.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], value), name
    np.testing.assert_array_equal(resumed.replay_buffer.actions, whole.replay_buffer.actions)
