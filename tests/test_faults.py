"""What happens when an environment fails; and that each row of the table of docs/trust.md has its test."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from faulty_environments import SMALL, Failing, raise_error, subproc, with_observation, with_reward
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize

from sb3_cgp import CGP
from sb3_cgp.guards.transitions import BoundsWatch, Transition

ROOT = Path(__file__).parent.parent

UNBOUNDED = spaces.Box(-np.inf, np.inf, (1,))


@pytest.mark.parametrize("vec_env", [DummyVecEnv, None], ids=["vectorised", "single"])
def test_an_exception_of_the_environment_reaches_the_user_unchanged(vec_env):
    env = Failing(raise_error) if vec_env is None else vec_env([lambda: Failing(raise_error)])
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ZeroDivisionError, match=r"^the simulator is unstable$"):
        model.learn(300)
    assert model.replay_buffer.size() == 14


@pytest.mark.parametrize("error", [EOFError, BrokenPipeError, ValueError, TypeError])
def test_an_error_of_the_environments_own_is_not_taken_for_a_fault_of_ours(error):
    def fail(*_):
        raise error("the simulator's own")

    with pytest.raises(error, match=r"^the simulator's own$"):
        CGP("MlpPolicy", Failing(fail), **SMALL).learn(300)


@pytest.mark.parametrize("shape", [(1,), (), (4,), (3, 1), (2, 3)], ids=str)
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_an_observation_of_a_wrong_shape_is_refused(shape, at):
    # The last observation of an episode takes another way
    model = CGP("MlpPolicy", Failing(with_observation(np.ones(shape)), at), **SMALL)
    with pytest.raises(ValueError, match=r"wrong shape at environment step 1[3-5]: the (terminal )?observation has") as caught:
        model.learn(300)
    assert f"has shape {shape}, where (3,) is expected" in str(caught.value)
    assert model.replay_buffer.size() == at - 1


def test_an_observation_of_a_wrong_shape_is_refused_from_workers_too():
    env = subproc(with_observation(np.ones(1)))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"wrong shape .* has shape \(1,\), where \(3,\) is expected"):
        model.learn(300)
    env.close()


def test_an_observation_that_numpy_stores_without_loss_is_taken():
    model = CGP("MlpPolicy", Failing(with_observation(np.full((1, 3), 7.0)), at=13), **SMALL)
    model.learn(20)
    assert np.all(model.replay_buffer.next_observations[12] == 7.0)
    # A training leaves the environment as it was
    assert "_save_obs" not in vars(model.env)


@pytest.mark.parametrize("reward", [np.ones(2), None, "high"], ids=str)
@pytest.mark.parametrize("monitored", [True, False])
def test_a_reward_that_is_no_number_is_refused(reward, monitored):
    wrapper = Monitor if monitored else lambda env: env
    model = CGP("MlpPolicy", DummyVecEnv([lambda: wrapper(Failing(with_reward(reward)))]), **SMALL)
    with pytest.raises(ValueError, match=r"returned a (reward that is not a number|NaN)|to float: 'high'"):
        model.learn(300)
    assert model.replay_buffer.size() == 14


@pytest.mark.parametrize("reward", [np.ones(2), None, "high"], ids=str)
def test_a_reward_that_is_no_number_is_refused_from_workers_too(reward):
    env = subproc(with_reward(reward))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"the reward has shape|a reward that is not a number"):
        model.learn(300)
    assert model.replay_buffer.size() == 14
    env.close()


@pytest.mark.parametrize("fault", [with_observation(np.array([0, np.nan, 0])), with_reward(np.inf)])
@pytest.mark.parametrize("make_vec_env", [lambda fault: DummyVecEnv([lambda: Failing(fault)]), subproc])
def test_a_nan_is_refused_before_it_is_stored(fault, make_vec_env):
    env = make_vec_env(fault)
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"NaN or infinite .* at environment step 15"):
        model.learn(300)
    assert model.replay_buffer.size() == 14
    env.close()


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("observation", [np.full(3, np.inf), np.full(3, -1e100), np.full(3, np.nan), np.ones(1)], ids=str)
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_observations_are_checked_before_they_are_normalised(observation, at):
    """VecNormalize clips them, and broadcasts the last one of an episode."""
    env = VecNormalize(DummyVecEnv([lambda: Failing(with_observation(observation), at)]))
    model = CGP("MlpPolicy", env, **SMALL)
    with pytest.raises(ValueError, match=r"(NaN or infinite|wrong shape) .*at environment step 1[3-5]"):
        model.learn(300)
    assert model.replay_buffer.size() == at - 1
    if at == 15:
        # The statistics, which VecNormalize updates first, have not seen it
        assert model.learn(5, reset_num_timesteps=False).num_timesteps >= 19


class Repaired(VecEnvWrapper):
    """Replaces what is infinite, also in an episode's last observation."""

    def reset(self):
        return np.nan_to_num(self.venv.reset())

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = np.nan_to_num(info["terminal_observation"], posinf=1.0)
        return np.nan_to_num(observations, posinf=1.0), rewards, dones, infos


@pytest.mark.parametrize("outer", [lambda env: env, VecNormalize], ids=["alone", "normalised"])
@pytest.mark.parametrize("at", [14, 15], ids=["within", "last"])
def test_observations_that_a_wrapper_repairs_are_trained_on(at, outer):
    env = outer(Repaired(DummyVecEnv([lambda: Failing(with_observation(np.full(3, np.inf)), at)])))
    assert CGP("MlpPolicy", env, **SMALL).learn(20).num_timesteps == 20


@pytest.mark.parametrize("normalised", [False, True])
def test_observations_out_of_bounds_are_warned_of_once(normalised):
    low = np.array([-5.0, -np.inf, -5.0])
    space = spaces.Box(low, -low, dtype=np.float64)
    outside = np.array([0.0, 99.0, -5.5])
    env = DummyVecEnv([lambda: Failing(observation_space=space), lambda: Failing(with_observation(outside), 8, space)])
    env.envs[1].observe = lambda: outside if env.envs[1].total >= 7 else np.zeros(3)
    model = CGP("MlpPolicy", VecNormalize(env) if normalised else env, **SMALL)
    with pytest.warns(UserWarning, match="outside of its observation space") as warned:
        model.learn(60)
    assert len(warned) == 1
    assert r"step 14: value -5.5 at index (2,), where the bounds are [-5.0, 5.0]" in str(warned[0].message)
    assert model.num_timesteps == 60


def test_normalised_images_are_not_out_of_bounds():
    """VecNormalize gives them a space of floats within ±clip_obs, which the images are not in before."""
    space = spaces.Box(0, 255, (3, 6, 6), np.uint8)
    env = VecNormalize(DummyVecEnv([lambda: Failing(with_observation(np.full((3, 6, 6), 200, np.uint8)), 3, space)]))
    env.venv.envs[0].observe = lambda: np.full((3, 6, 6), 200, np.uint8)
    model = CGP("MlpPolicy", env, **(SMALL | dict(policy_kwargs=dict(net_arch=[4], normalize_images=False))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(30)


def test_the_bounds_of_each_part_of_an_observation_are_watched():
    parts = {"position": spaces.Box(-1, 1, (2,)), "image": spaces.Box(0, 255, (2, 2), np.uint8), "free": UNBOUNDED}
    watch = BoundsWatch(spaces.Dict(parts))
    inside = {"position": np.ones((1, 2)), "image": np.zeros((1, 2, 2)), "free": np.full((1, 1), 1e9)}
    watch(Transition(3, spaces.Dict(parts), inside, None, [], 1))
    with pytest.warns(UserWarning, match=r"an observation `position` .* step 4: value 2.0 at index \(1,\)"):
        watch(Transition(4, spaces.Dict(parts), {**inside, "position": np.array([[0.0, 2.0]])}, None, [], 1))


def test_bounds_are_compared_in_the_data_type_of_the_space():
    box = spaces.Box(-0.7, 0.7, (1,), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        BoundsWatch(box)(Transition(3, box, np.array([[0.7]]), None, [], 1))
    with pytest.warns(UserWarning, match="outside of its observation space"):
        BoundsWatch(box)(Transition(3, box, np.array([[0.71]]), None, [], 1))


def test_every_fault_in_the_documentation_has_its_test():
    section = (ROOT / "docs" / "trust.md").read_text().partition("## Faults\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][2:]
    assert len(rows) > 10
    for row in rows:
        named = re.findall(r"`tests/(test_\w+\.py)::(test_\w+)`", row.split(" | ")[-1])
        assert named, row
        for file, test in named:
            assert f"def {test}(" in (ROOT / "tests" / file).read_text(), test
