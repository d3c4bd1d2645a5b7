"""Evaluation of all agents of a population, and SB3's callbacks and log."""

import math

import gymnasium as gym
import numpy as np
import pytest
from populations import Log, make, make_env
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnNoModelImprovement
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from sb3_cgp.population import Population, PopulationEvalCallback, evaluate_population


def test_all_agents_are_evaluated_at_once(tmp_path):
    callback = PopulationEvalCallback(
        make_vec_env("Pendulum-v1", 2, seed=5), eval_freq=25, n_eval_episodes=2, log_path=str(tmp_path)
    )
    assert callback.mean_rewards.shape == (0,)
    population = make(2, env="Pendulum-v1").learn(2 * 60, callback=callback)
    assert callback.mean_rewards.shape == (2, 2)
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["timesteps"].tolist() == [25, 50]
        assert saved["results"].shape == saved["ep_lengths"].shape == (2, 2, 2)
        np.testing.assert_array_equal(saved["results"].mean(axis=2), callback.mean_rewards)
    # Each agent acts in its own environment: as it does alone in an environment of the same seed
    returns, lengths = evaluate_population(population, make_vec_env("Pendulum-v1", 2, seed=9), 1)
    assert (lengths == 200).all()
    for index in range(2):
        env = make_vec_env("Pendulum-v1", 1, seed=9 + index)
        alone, _ = evaluate_policy(population[index], env, n_eval_episodes=1)
        assert returns[index, 0] == pytest.approx(alone, rel=1e-3)
    assert returns[0, 0] != returns[1, 0]


def test_sb3s_callbacks_and_log_take_a_population(tmp_path):
    evaluation = EvalCallback(make_env(2), eval_freq=10, n_eval_episodes=4, verbose=0, warn=False)
    checkpoints = CheckpointCallback(20, tmp_path)
    population, log = make(2, policy_delay=5), Log()
    population.set_logger(Logger(None, [log]))
    population.learn(2 * 45, callback=[evaluation, checkpoints], log_interval=2)
    assert np.isfinite(evaluation.last_mean_reward)
    assert len(Population.load(tmp_path / "rl_model_80_steps")) == 2
    logged = {name: value for row in log.rows for name, value in row.items()}
    for name in ("critic_loss", "actor_loss", "q_value", "learning_rate", "failed_agents"):
        assert math.isfinite(logged[f"train/{name}"])
    assert logged["train/n_updates"] == 24
    assert logged["eval/mean_reward"] == evaluation.last_mean_reward


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: make_env(1), r"`eval_env.num_envs` is 1, but must be 2, as many as agents"),
        (lambda: gym.make("Pendulum-v1"), r"`eval_env` is .*, but must be a VecEnv, as `make_vec_env\(task, n_envs=2\)`"),
    ],
)
def test_another_environment_is_refused_before_the_training(env, message):
    population = make(2)
    with pytest.raises(ValueError, match=message):
        population.learn(2 * 30, PopulationEvalCallback(env(), eval_freq=25))
    assert population.num_timesteps == 0


def test_training_stops_when_the_mean_over_the_agents_no_longer_improves():
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1)
    callback = PopulationEvalCallback(make_env(2), stop, eval_freq=5, n_eval_episodes=1, verbose=0)
    population = make(2).learn(2 * 400, callback)
    means = callback.mean_rewards.mean(axis=1)
    assert callback.last_mean_reward == means[-1]
    assert callback.best_mean_reward == means.max()
    # The last two evaluations were no better than one before them
    assert means[-2:].max() <= means[:-2].max()
    assert len(means) == population.num_timesteps / 2 / 5 < 80


def test_the_evaluation_of_a_population_refuses_a_single_agent():
    agent = make(1).agent(0, env=make_env(1))
    with pytest.raises(ValueError, match=r"`model` is 'CGP', but must be a Population.* use SB3's EvalCallback"):
        agent.learn(5, callback=PopulationEvalCallback(make_env(1)))
    assert agent.num_timesteps == 0
