"""An environment that was reset, stepped or left by others than the training: no transition crosses the gap."""

import contextlib
import copy
import itertools
import pickle

import numpy as np
import pytest
from guarded import SMALL, GuardedTD3, Located, assert_no_episode_runs_into_another, located
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from trainings import Do

from sb3_cgp.common.episodes import end_last_episode
from sb3_cgp.fast.device_replay import DeviceReplayBuffer
from sb3_cgp.guards.observations import continues_last_episode

BUFFERS = {
    "plain": dict(),
    "n-step": dict(n_steps=3),
    "memory-efficient": dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    "hindsight": dict(replay_buffer_class=HerReplayBuffer, learning_starts=16),
}

pytestmark = [
    pytest.mark.filterwarnings("ignore:The last trajectory in the replay buffer will be truncated"),
    pytest.mark.filterwarnings("ignore:Nothing is learnt"),
    pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped"),
]


def make_model(kind, n_envs=1, env=None, **kwargs):
    goals = kind == "hindsight"
    policy = "MultiInputPolicy" if goals else "MlpPolicy"
    return GuardedTD3(policy, located(n_envs, goals=goals) if env is None else env, **(SMALL | BUFFERS[kind] | kwargs))


def learn_again(model, folder):
    return model.learn(20)


def learn_on_with_no_last_observation(model, folder):
    model._last_obs = None
    return model.learn(20, reset_num_timesteps=False)


def set_env(model, folder):
    model.set_env(located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer)))
    return model.learn(20, reset_num_timesteps=False)


def set_env_again(model, folder):
    model.set_env(model.get_env())
    return model.learn(20, reset_num_timesteps=False)


def set_env_without_a_reset(model, folder):
    env = located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer))
    env.reset()
    model.set_env(env, force_reset=False)
    return model.learn(20, reset_num_timesteps=False)


def reload(model, folder):
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    env = located(model.n_envs, goals=isinstance(model.replay_buffer, HerReplayBuffer))
    loaded = GuardedTD3.load(folder / "model", env)
    loaded.load_replay_buffer(folder / "buffer", truncate_last_traj=False)
    return loaded.learn(20, reset_num_timesteps=False)


def load_an_older_buffer(model, folder):
    model.save_replay_buffer(folder / "buffer")
    model.learn(11, reset_num_timesteps=False)
    if isinstance(model.replay_buffer, HerReplayBuffer):
        # SB3 has its buffer's environment set once
        model.replay_buffer.env = None
    model.load_replay_buffer(folder / "buffer", truncate_last_traj=False)
    return model.learn(20, reset_num_timesteps=False)


def interrupted_by(function):
    def interrupt(model, folder):
        with contextlib.suppress(KeyboardInterrupt):
            model.learn(20, Do(4, lambda: function(model)), reset_num_timesteps=False)
        return model.learn(20, reset_num_timesteps=False)

    return interrupt


def press_ctrl_c(model):
    raise KeyboardInterrupt


def fail_in_the_next_step(model):
    env = model.get_env()
    step_wait = env.step_wait

    def fail():
        env.step_wait = step_wait
        step_wait()
        raise KeyboardInterrupt

    env.step_wait = fail


def stopped_by_a_callback(model, folder):
    class Stop(Do):
        def _on_step(self):
            return self.n_calls < self.step

    model.learn(20, Stop(4, None), reset_num_timesteps=False)
    return model.learn(20, reset_num_timesteps=False)


def evaluated_between(model, folder):
    evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    return model.learn(20, reset_num_timesteps=False)


def stepped_between(model, folder):
    model.get_env().step(np.zeros((model.n_envs, 1)))
    return model.learn(20, reset_num_timesteps=False)


def reset_between(model, folder):
    model.get_env().reset()
    return model.learn(20, reset_num_timesteps=False)


WAYS = [
    learn_again,
    learn_on_with_no_last_observation,
    set_env,
    set_env_again,
    set_env_without_a_reset,
    reload,
    load_an_older_buffer,
    interrupted_by(press_ctrl_c),
    interrupted_by(fail_in_the_next_step),
    stopped_by_a_callback,
    evaluated_between,
    stepped_between,
    reset_between,
]
NAMES = [
    *(way.__name__ for way in WAYS[:7]),
    "interrupted in a callback",
    "interrupted in a step",
    *(w.__name__ for w in WAYS[9:]),
]


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("way", WAYS, ids=NAMES)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_no_transition_runs_from_an_episode_into_the_next(kind, way, n_envs, tmp_path):
    model = make_model(kind, n_envs)
    model.learn(18)
    model = way(model, tmp_path)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=model.n_steps)


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("buffer_size", [15, 18, 21])
def test_no_transition_crosses_where_the_ring_begins_anew(kind, buffer_size, tmp_path):
    for steps in (buffer_size, buffer_size + 4):
        # Whole, or wrapped around; episodes of 7 steps are shorter
        model = make_model(kind, buffer_size=buffer_size)
        model.learn(steps)
        assert model.replay_buffer.full
        model.learn(4)
        assert_no_episode_runs_into_another(model.replay_buffer, n_steps=model.n_steps)


def test_sb3_itself_lets_returns_run_into_the_next_episode():
    """The oracle sees the fault where it is."""
    model = TD3("MlpPolicy", located(), n_steps=3, **SMALL)
    model.learn(18)
    model.learn(20)
    with pytest.raises(AssertionError):
        assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


@pytest.mark.parametrize("kind", BUFFERS)
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("normalises", [False, True])
def test_a_training_in_two_parts_is_the_same_as_in_one(kind, n_envs, normalises, monkeypatch):
    """An episode that goes on is not ended."""
    buffers = []
    for parts in ([40], [18, 22]):
        monkeypatch.setattr(Located, "numbers", itertools.count())
        env = located(n_envs, goals=kind == "hindsight")
        model = make_model(kind, env=VecNormalize(env) if normalises else env, learning_starts=100)
        for part in parts:
            model.learn(part, reset_num_timesteps=False)
        buffers.append(model.replay_buffer)
    for name in ("rewards", "dones", "timeouts", "actions"):
        np.testing.assert_array_equal(*(getattr(buffer, name) for buffer in buffers), err_msg=name)
    assert buffers[0].dones.sum() == 40 // n_envs // 7 * n_envs


@pytest.mark.parametrize(
    "vec_env", [DummyVecEnv, lambda fns: SubprocVecEnv(fns, start_method="fork")], ids=["here", "workers"]
)
@pytest.mark.parametrize("normalises", [False, True])
@pytest.mark.parametrize("what", ["nested training", "evaluation", "reset"])
def test_an_environment_that_a_callback_moves_begins_an_episode(vec_env, normalises, what):
    env = vec_env([Located, Located])
    env = VecNormalize(env, norm_obs=False) if normalises else env
    model = make_model("n-step", env=env)

    def move():
        if what == "nested training":
            GuardedTD3("MlpPolicy", env, **SMALL).learn(16)
        elif what == "evaluation":
            evaluate_policy(model, env, n_eval_episodes=1)
        else:
            env.reset()

    with pytest.warns(UserWarning, match="was reset or stepped outside of this training, at environment step 16") as warned:
        model.learn(40, [Do(8, move), Do(14, move)])
    # Each training is told once
    assert len([each for each in warned if "outside of this training" in str(each.message)]) == 1
    assert model.num_timesteps == 40
    assert "_save_obs" not in vars(env.unwrapped)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    # The step in which the callback moved it was made too
    observations = model.replay_buffer.observations[:20]
    assert np.all(model.replay_buffer.next_observations[:20, :, 1] == observations[:, :, 1] + 1)
    env.close()


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("when", ["step", "reset"])
def test_replies_of_workers_that_an_interruption_left_unread_are_not_taken_for_others(index, when):
    env = SubprocVecEnv([Located] * 3, start_method="fork")
    model = make_model("n-step", env=env).learn(18)
    remote = env.remotes[index]

    def fail():
        del remote.recv
        raise KeyboardInterrupt

    def interrupt():
        remote.recv = fail

    if when == "step":
        with pytest.raises(KeyboardInterrupt):
            model.learn(30, Do(4, interrupt), reset_num_timesteps=False)
    else:
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            env.reset()
    model.learn(30, reset_num_timesteps=False)
    model.learn(30)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    env.close()


def test_nested_trainings_leave_the_environment_as_it_was():
    env = located()
    inner = make_model("plain", env=env)
    outer = make_model("plain", env=env)
    outer.learn(15, Do(5, lambda: inner.learn(10, Do(5, lambda: make_model("plain", env=env).learn(9)))))
    assert "_save_obs" not in vars(env)
    assert "reset" not in vars(env.envs[0])
    for model in (outer, inner):
        assert_no_episode_runs_into_another(model.replay_buffer)


def test_a_copy_that_is_made_while_it_learns_is_the_models_own():
    model, copies = make_model("n-step"), []
    model.learn(15, Do(9, lambda: copies.extend([copy.deepcopy(model), pickle.loads(pickle.dumps(model))])))
    size = model.replay_buffer.size()
    for each in copies:
        each.learn(20, reset_num_timesteps=False)
        assert_no_episode_runs_into_another(each.replay_buffer, n_steps=3)
    assert model.replay_buffer.size() == size
    model.learn(20, reset_num_timesteps=False)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))], ids=["copy", "pickle"])
def test_a_copied_model_goes_on_where_it_was(copier):
    model = make_model("n-step").learn(18)
    other = copier(model)
    other.learn(20, reset_num_timesteps=False)
    np.testing.assert_array_equal(other.replay_buffer.dones[:38, 0].nonzero()[0], [6, 13, 20, 27, 34])


def row(number):
    """A transition, its observation and reward, for the tests of a buffer alone."""
    here = np.full((2, 1), number, np.float32)
    return here, here + 1, np.zeros((2, 1), np.float32), np.full(2, number)


@pytest.mark.parametrize(("done", "timeout"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("n_rows", [1, 3, 5, 7])
def test_an_episode_that_had_ended_ends_as_it_had(done, timeout, n_rows):
    """Bootstrapping is that of the episode's own end: a timeout stays one."""
    env = located(2)
    buffer = NStepReplayBuffer(10, env.observation_space, env.action_space, n_envs=2, n_steps=3)
    for number in range(n_rows):
        is_last = number == n_rows - 1
        ends = np.array([False, done and is_last])
        buffer.add(*row(number), ends, [{}, {"TimeLimit.truncated": timeout and is_last}])
    end_last_episode(buffer)
    end_last_episode(buffer)
    last = buffer.pos - 1
    assert buffer.dones[last].tolist() == [1, 1]
    assert buffer.timeouts[last].tolist() == [1, float(timeout or not done)]
    assert buffer.dones.sum() == 2


def test_an_episode_ends_in_tensors_as_in_arrays():
    env = located(2)
    buffers = [
        each(10, env.observation_space, env.action_space, "cpu", n_envs=2) for each in (ReplayBuffer, DeviceReplayBuffer)
    ]
    for buffer in buffers:
        buffer.add(*row(0), np.array([False, True]), [{}, {"TimeLimit.truncated": True}])
        # The first environment's episode goes on, and the second one's new episode may start anywhere
        goes_on = np.array([[1, 1], [5, 5]], np.float32)
        assert continues_last_episode(buffer, goes_on)
        assert not continues_last_episode(buffer, goes_on + 1)
        end_last_episode(buffer)
        assert continues_last_episode(buffer, goes_on + 1)
    for name in ("dones", "timeouts"):
        np.testing.assert_array_equal(*(np.asarray(getattr(buffer, name)) for buffer in buffers))
        assert np.asarray(getattr(buffers[1], name))[0].tolist() == [1, 1]


def test_an_empty_buffer_stays_empty():
    env = located()
    for buffer_class in (ReplayBuffer, NStepReplayBuffer, DeviceReplayBuffer):
        buffer = buffer_class(10, env.observation_space, env.action_space)
        end_last_episode(buffer)
        assert buffer.dones.sum() == buffer.size() == 0


class Overwriting(VecEnvWrapper):
    """Returns one array, which it overwrites at the next step, as an environment for GPUs or in shared memory may."""

    def reset(self):
        self.shared = self.venv.reset()
        return self.shared

    def step_wait(self):
        observations, *others = self.venv.step_wait()
        self.shared[:] = observations
        return self.shared, *others


def test_an_array_that_the_environment_overwrites_is_copied():
    model = make_model("n-step", env=Overwriting(located(2)))
    model.learn(30)
    model.learn(30, reset_num_timesteps=False)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    assert model.replay_buffer.dones.sum() == 2 * (30 // 7)


class Reusing(Located):
    """Keeps its observation in one array, which `reset` overwrites."""

    def __init__(self):
        super().__init__()
        self.array = np.zeros(2, np.float32)

    def observe(self):
        self.array[:] = self.episode, self.steps
        return self.array


def test_a_final_observation_that_reset_overwrites_is_copied():
    model = make_model("n-step", env=DummyVecEnv([Reusing, Reusing]))
    model.learn(60)
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)
    ends = model.replay_buffer.dones[:30] == 1
    np.testing.assert_array_equal(model.replay_buffer.next_observations[:30][ends][:, 1], 7)


@pytest.mark.parametrize("within", ["Monitor", "TimeLimit"])
@pytest.mark.parametrize("when", ["between", "in a callback"])
def test_an_environment_that_is_shared_with_an_evaluation_is_noticed(within, when):
    env = Monitor(Located(50)) if within == "Monitor" else TimeLimit(Located(50), 20)
    model = make_model("n-step", env=env)
    # In a vectorised environment of its own
    evaluation = DummyVecEnv([lambda: env])
    if when == "between":
        model.learn(15)
        evaluate_policy(model, evaluation, n_eval_episodes=1, warn=False)
        model.learn(15, reset_num_timesteps=False)
    else:
        with pytest.warns(UserWarning, match="The training environment was reset or stepped outside of this training"):
            model.learn(30, callback=Do(15, lambda: evaluate_policy(model, evaluation, n_eval_episodes=1, warn=False)))
    assert_no_episode_runs_into_another(model.replay_buffer, n_steps=3)


class Foreign(VecEnv):
    """A vectorised environment of another package, which keeps neither actions nor infos, as simulators on a GPU."""

    def __init__(self, infos):
        self.inner, self.infos = Located(), infos
        super().__init__(1, self.inner.observation_space, self.inner.action_space)

    @property
    def reset_infos(self):
        return None if self.infos is None else [{}]

    @reset_infos.setter
    def reset_infos(self, infos):
        pass

    def reset(self):
        return self.inner.reset()[0][None]

    def step_async(self, actions):
        self.given = actions

    def step_wait(self):
        observation, reward, terminated, truncated, info = self.inner.step(self.given[0])
        if terminated or truncated:
            info = {"terminal_observation": observation, "TimeLimit.truncated": truncated}
            observation = self.inner.reset()[0]
        return observation[None], np.array([reward]), np.array([terminated or truncated]), [info]

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.inner, attr_name)]

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False]


class ToSimulator(VecEnvWrapper):
    """Says that what it wraps is a simulator, as a robot's package does."""

    @property
    def unwrapped(self):
        return object()

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


@pytest.mark.parametrize("infos", [None, "new ones"])
@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor, VecNormalize, ToSimulator])
def test_environments_of_other_packages_are_trained_on_as_by_sb3(infos, wrap):
    guarded, plain = (algorithm("MlpPolicy", wrap(Foreign(infos)), **SMALL).learn(30) for algorithm in (GuardedTD3, TD3))
    assert guarded._n_updates == plain._n_updates == 24
    np.testing.assert_array_equal(guarded.replay_buffer.dones, plain.replay_buffer.dones)
    assert_no_episode_runs_into_another(guarded.replay_buffer) if wrap is not VecNormalize else None


def test_an_environment_that_a_callback_sets_within_a_step_is_refused():
    model = make_model("plain")
    with pytest.raises(RuntimeError, match="`set_env` was called by a callback in the middle of a step"):
        model.learn(30, callback=Do(15, lambda: model.set_env(located())))
    model.set_env(located())
    model.learn(20, reset_num_timesteps=False)
    assert np.isfinite(model.replay_buffer.observations).all()
    assert_no_episode_runs_into_another(model.replay_buffer)
