"""The replay buffer on the model's device: the same transitions as SB3's to the bit, and the same training."""

import pickle

import numpy as np
import pytest
import torch as th
from environments import Doubles
from gymnasium import spaces
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cgp import CGP
from sb3_cgp.fast.device_replay import DeviceReplayBuffer, fits_device

FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
# An odd number of bytes, after which floats need padding
IMAGE = spaces.Box(0, 255, (1, 5, 7), np.uint8)
ACTION = spaces.Box(-1, 1, (2,), np.float64)
CPU = th.device("cpu")


def fill(buffers, steps, seed=0):
    """Add the same random transitions, float64 where the space is of floats, to every buffer."""
    rng = np.random.default_rng(seed)
    space, n_envs = buffers[0].observation_space, buffers[0].n_envs
    for step in range(steps):
        values = rng.normal(size=(2, n_envs, *space.shape))
        obs, next_obs = values if space is VECTOR else rng.integers(0, 256, values.shape, np.uint8)
        done = rng.random(n_envs) < 0.7
        infos = [{"TimeLimit.truncated": step % 2 == 0} if ends else {} for ends in done]
        transition = (obs, next_obs, rng.normal(size=(n_envs, 2)), rng.normal(size=n_envs), done, infos)
        for buffer in buffers:
            buffer.add(*transition)


def samples(buffer, size=64, env=None, seed=1):
    np.random.seed(seed)  # noqa: NPY002
    batches = [buffer.sample(size, env=env) for _ in range(2)]
    return [tensor for batch in batches for tensor in batch if tensor is not None]


def assert_same(ours, theirs):
    assert len(ours) == len(theirs) == 10
    for our, their in zip(ours, theirs, strict=True):
        assert (our.dtype, our.shape, our.stride()) == (their.dtype, their.shape, their.stride())
        assert th.equal(our.cpu(), their)


@pytest.mark.parametrize("steps", [9, 20, 27])
@pytest.mark.parametrize("handles_timeouts", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("space", [VECTOR, IMAGE], ids=["vector", "image"])
def test_transitions_are_sb3s_to_the_bit(space, n_envs, handles_timeouts, steps):
    ours, theirs = buffers = [
        buffer_class(20 * n_envs + n_envs // 2, space, ACTION, CPU, n_envs, handle_timeout_termination=handles_timeouts)
        for buffer_class in (DeviceReplayBuffer, ReplayBuffer)
    ]
    fill(buffers, steps)
    assert_same(samples(ours), samples(theirs))
    assert (ours.pos, ours.full, ours.size(), ours.buffer_size) == (theirs.pos, theirs.full, theirs.size(), 20)
    for name in FIELDS:
        stored = getattr(ours, name).numpy()
        assert stored.dtype == getattr(theirs, name).dtype
        assert np.array_equal(stored, getattr(theirs, name))
    # The comparison covers timeouts only where there are some
    assert theirs.timeouts.any() == handles_timeouts


@pytest.mark.parametrize("kwargs", [dict(), dict(norm_obs=False), dict(norm_reward=False)])
def test_vec_normalize_normalises_as_in_sb3(kwargs):
    env = VecNormalize(make_vec_env("Pendulum-v1", 2), **kwargs)
    env.seed(0)
    env.reset()
    for _ in range(5):
        env.step(np.ones((2, 1)))
    buffers = [buffer_class(40, VECTOR, ACTION, CPU, 2) for buffer_class in (DeviceReplayBuffer, ReplayBuffer)]
    fill(buffers, 20)
    ours, theirs = (samples(buffer, env=env) for buffer in buffers)
    assert_same(ours, theirs)
    plain = samples(buffers[0])
    assert [th.equal(ours[i], plain[i]) for i in (0, 2, 4)] == [not env.norm_obs, not env.norm_obs, not env.norm_reward]


def test_attributes_work_as_sb3s_arrays_do():
    ours, theirs = buffers = [buffer_class(6, VECTOR, ACTION, CPU, 2) for buffer_class in (DeviceReplayBuffer, ReplayBuffer)]
    transitions = [np.ones((4, 2, width)) for width in (3, 3, 2)] + [np.arange(8.0).reshape(4, 2), np.zeros((4, 2))]
    for buffer in buffers:
        buffer.extend(*transitions, [[{}, {}]] * 4)
        buffer.dones[1] = True
        buffer.rewards[:] *= 2.0
    assert_same(samples(ours), samples(theirs))
    for name in ("observations", "rewards"):
        flat = ours.swap_and_flatten(getattr(ours, name))
        assert np.array_equal(flat.numpy(), theirs.swap_and_flatten(getattr(theirs, name)))
    for buffer in buffers:
        buffer.reset()
        assert (buffer.size(), buffer.full) == (0, False)


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (VECTOR, dict(optimize_memory_usage=True), r"`optimize_memory_usage` is True, but must be False"),
        (spaces.Discrete(3), dict(), r"`observation_space` is Discrete\(3\), but must be a Box"),
    ],
)
def test_what_it_cannot_hold_is_refused(space, kwargs, message):
    with pytest.raises(ValueError, match=message):
        DeviceReplayBuffer(10, space, ACTION, CPU, **kwargs)


def test_assigning_the_device_moves_the_storage():
    buffer = DeviceReplayBuffer(10, VECTOR, ACTION, CPU)
    buffer.device = th.device("meta")
    assert {getattr(buffer, name).device.type for name in FIELDS} == {"meta"}
    assert buffer.device.type == "meta"


@pytest.mark.parametrize(("saved_from", "loaded_on"), [("cpu", "cpu"), ("meta", "meta"), ("cuda:7", "cpu")])
def test_pickle_is_of_numpy_arrays_and_goes_where_there_is_the_device(saved_from, loaded_on):
    buffer = DeviceReplayBuffer(10, VECTOR, ACTION, CPU)
    fill([buffer], 5)
    state = buffer.__getstate__()
    assert not any(isinstance(value, th.Tensor) for value in state.values())
    loaded = DeviceReplayBuffer.__new__(DeviceReplayBuffer)
    loaded.__setstate__(pickle.loads(pickle.dumps(state | {"device": th.device(saved_from)})))
    assert loaded.device.type == loaded.rewards.device.type == loaded_on
    if loaded_on == "cpu":
        assert_same(samples(pickle.loads(pickle.dumps(buffer))), samples(buffer))
        fill([buffer, loaded], 3, seed=2)
        assert_same(samples(loaded), samples(buffer))


def test_rule_takes_sb3s_default_buffer_of_boxes_on_a_gpu_alone(monkeypatch):
    # Whichever build of PyTorch this is
    monkeypatch.setattr(th.version, "cuda", "13.0")
    gpu = th.device("cuda", 1)
    assert fits_device(ReplayBuffer, VECTOR, False, gpu)
    assert fits_device(ReplayBuffer, IMAGE, False, gpu)
    assert not fits_device(ReplayBuffer, VECTOR, False, CPU)
    assert not fits_device(ReplayBuffer, VECTOR, True, gpu)
    assert not fits_device(ReplayBuffer, spaces.Discrete(3), False, gpu)
    others = (NStepReplayBuffer, DictReplayBuffer, HerReplayBuffer, type("Custom", (ReplayBuffer,), {}))
    assert not any(fits_device(buffer_class, VECTOR, False, gpu) for buffer_class in others)


class Ending(Doubles):
    """Some of its episodes end by a timeout, the others for good."""

    def ends_by_timeout(self):
        return bool(self.np_random.random() < 0.5)


class Images(Ending):
    """The same with images."""

    observation_space = spaces.Box(0, 255, (3, 36, 36), np.uint8)

    def observe(self):
        return self.np_random.integers(0, 256, (3, 36, 36), np.uint8)


def make_env(n_envs=1, normalises=False, env_class=Ending):
    env = DummyVecEnv([env_class] * n_envs)
    env.seed(0)
    return VecNormalize(env) if normalises else env


def make_model(env, policy="MlpPolicy", **kwargs):
    small = dict(learning_starts=30, buffer_size=60, batch_size=8, cem_samples=8, cem_elites=2, seed=0, device="cpu")
    return CGP(policy, env, policy_kwargs=dict(net_arch=[8]), **(small | dict(cuda_graphs=True) | kwargs))


def test_the_buffer_stays_sb3s_unless_asked_for(monkeypatch):
    monkeypatch.setattr("sb3_cgp.fast.device_replay.has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (2**30, 2**30))
    assert type(make_model(make_env(), cuda_graphs=False).replay_buffer) is ReplayBuffer
    assert type(make_model(make_env()).replay_buffer) is DeviceReplayBuffer


def parameters(model):
    return th.cat([parameter.flatten() for parameter in model.policy.parameters()])


@pytest.fixture
def cpu_counts(monkeypatch):
    """Let the CPU count as a GPU."""
    monkeypatch.setattr("sb3_cgp.fast.device_replay.has_cuda_graphs", lambda device: True)
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (2**30, 2**30))


@pytest.mark.parametrize(
    ("n_envs", "normalises", "env_class", "policy"),
    [
        (1, False, Ending, "MlpPolicy"),
        (1, True, Ending, "MlpPolicy"),
        (3, False, Ending, "MlpPolicy"),
        (3, True, Ending, "MlpPolicy"),
        (1, False, Images, "CnnPolicy"),
    ],
)
def test_training_is_the_same_to_the_bit_as_with_sb3s_buffer(cpu_counts, monkeypatch, n_envs, normalises, env_class, policy):
    steps = 40 if policy == "CnnPolicy" else 80
    ours = make_model(make_env(n_envs, normalises, env_class), policy).learn(steps)
    monkeypatch.undo()
    theirs = make_model(make_env(n_envs, normalises, env_class), policy).learn(steps)
    assert (type(ours.replay_buffer), type(theirs.replay_buffer)) == (DeviceReplayBuffer, ReplayBuffer)
    assert ours._n_updates == theirs._n_updates > 0
    assert ours.replay_buffer.full == theirs.replay_buffer.full == (steps == 80)
    assert th.equal(parameters(ours), parameters(theirs))


def resume(model, path, normalises):
    """Save a model and its buffer, load them, and go on."""
    model.save(path / "model")
    model.save_replay_buffer(path / "buffer")
    loaded = CGP.load(path / "model", make_env(2, normalises), device="cpu")
    assert loaded.replay_buffer is None
    loaded.load_replay_buffer(path / "buffer")
    assert type(loaded.replay_buffer) is type(model.replay_buffer)
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    return loaded.learn(20, reset_num_timesteps=False)


@pytest.mark.parametrize("normalises", [False, True])
def test_loaded_model_goes_on_as_with_sb3s_buffer(cpu_counts, monkeypatch, tmp_path, normalises):
    ours = make_model(make_env(2, normalises)).learn(60)
    # The model does not remember a buffer that depends on its device
    assert ours.replay_buffer_class is None
    monkeypatch.undo()
    theirs = make_model(make_env(2, normalises)).learn(60)
    before = parameters(ours)
    ours, theirs = (resume(model, tmp_path, normalises) for model in (ours, theirs))
    assert th.equal(parameters(ours), parameters(theirs))
    assert not th.equal(parameters(ours), before)


def test_model_from_a_gpu_has_sb3s_buffer_on_a_cpu(cpu_counts, monkeypatch, tmp_path):
    make_model(make_env()).learn(40).save(tmp_path / "model")
    monkeypatch.undo()
    loaded = CGP.load(tmp_path / "model", make_env(), device="cpu").learn(40)
    assert type(loaded.replay_buffer) is ReplayBuffer


def test_buffer_of_sb3_loads_where_ours_would_be_allocated(cpu_counts, tmp_path):
    td3 = TD3("MlpPolicy", make_env(), learning_starts=100, buffer_size=120, device="cpu").learn(60)
    td3.save_replay_buffer(tmp_path / "buffer")
    model = make_model(make_env())
    model.load_replay_buffer(tmp_path / "buffer")
    assert type(model.replay_buffer) is ReplayBuffer
    assert model.learn(60)._n_updates == 30


def test_other_buffers_are_allocated_as_they_are(cpu_counts):
    assert type(make_model(make_env(), n_steps=3).replay_buffer) is NStepReplayBuffer
    lean = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    assert type(make_model(make_env(), **lean).replay_buffer) is ReplayBuffer
    ours = make_model(make_env(), replay_buffer_kwargs=dict(handle_timeout_termination=False)).replay_buffer
    assert (type(ours), ours.handle_timeout_termination) == (DeviceReplayBuffer, False)


def test_a_gpu_without_enough_memory_leaves_the_buffer_to_the_host(cpu_counts, monkeypatch):
    # 60 transitions with two observations of three float32 each
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (2 * 60 * 2 * 3 * 4, 10**9))
    assert type(make_model(make_env()).replay_buffer) is DeviceReplayBuffer
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (2 * 60 * 2 * 3 * 4 - 1, 10**9))
    with pytest.warns(UserWarning, match="A replay buffer of 60 takes over half of cpu's free memory: it is kept on the host"):
        model = make_model(make_env())
    monkeypatch.undo()
    assert type(model.replay_buffer) is ReplayBuffer
    assert model.learn(40)._n_updates == 10


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("space", [VECTOR, IMAGE], ids=["vector", "image"])
def test_sampling_on_a_gpu_is_the_same(space):
    ours, theirs = buffers = [DeviceReplayBuffer(40, space, ACTION, "cuda", 2), ReplayBuffer(40, space, ACTION, CPU, 2)]
    fill(buffers, 27)
    batch = samples(ours)
    assert {tensor.device.type for tensor in batch} == {"cuda"}
    assert_same(batch, samples(theirs))
    loaded = pickle.loads(pickle.dumps(ours))
    assert loaded.device.type == "cuda"
    loaded.device = CPU
    assert_same(samples(loaded), samples(theirs))


@pytest.mark.usefixtures("gpu")
def test_models_on_a_gpu_and_on_a_cpu_load_each_others_buffers(tmp_path):
    models = {device: make_model(make_env(), device=device).learn(40) for device in ("cuda", "cpu")}
    assert type(models["cuda"].replay_buffer) is DeviceReplayBuffer
    for device, model in models.items():
        model.save_replay_buffer(tmp_path / device)
    for device, other in (("cuda", "cpu"), ("cpu", "cuda")):
        models[device].load_replay_buffer(tmp_path / other)
        assert models[device].replay_buffer.sample(4).observations.device.type == device
        assert models[device].learn(40)._n_updates == 20
