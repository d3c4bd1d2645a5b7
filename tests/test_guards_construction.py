"""Wrong values of arguments are refused by name, with the remedy, and environments are taken by their names."""

import inspect
import re
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from guarded import SMALL, GuardedTD3, make
from small_models import make_model
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.td3.policies import TD3Policy

from sb3_cgp import CGP
from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.fast.policies import MlpPolicy
from sb3_cgp.guards import GuardedAlgorithm
from sb3_cgp.population import Population


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "model"
    make().save(path)
    return path


WRONG_VALUES = [
    ("verbose", "1", "0 for no output"),
    ("policy_kwargs", [8], "None or a dictionary, such as dict(net_arch=[64, 64])"),
    ("stats_window_size", "3", "an int >= 0, or None"),
    ("stats_window_size", np.int64(3), "an int >= 0, or None"),
    ("tensorboard_log", 3, "None or the path of a folder"),
    ("seed", "a", "None or an integer within [0, 2**32)"),
    ("seed", -1, "None or an integer within [0, 2**32)"),
    ("device", "gpu", "'auto', or a device that PyTorch can use here"),
    ("device", "xpu", "'auto', or a device that PyTorch can use here"),
    ("replay_buffer_kwargs", [1], "None or a dictionary"),
    ("replay_buffer_class", "HerReplayBuffer", "None or a class of replay buffers"),
    ("optimize_memory_usage", "no", "True or False"),
]


@pytest.mark.parametrize(("name", "value", "allowed"), WRONG_VALUES)
def test_a_wrong_argument_is_refused_by_name_before_sb3_uses_it(name, value, allowed, saved):
    message = re.escape(f"The value of `{name}` is {value!r}, but must be {allowed}")
    with pytest.raises(ValueError, match=message):
        make(**{name: value})
    if name != "policy_kwargs":
        with pytest.raises(ValueError, match=message):
            CGP.load(saved, **{name: value})


@pytest.mark.parametrize("name", ["verbose", "stats_window_size", "seed"])
def test_a_population_refuses_the_same_arguments(name):
    with pytest.raises((ValueError, TypeError), match=f"`{name}` is 'x', but must be"):
        Population("MlpPolicy", "Pendulum-v1", 2, **SMALL | {name: "x"})


@pytest.mark.parametrize(
    "arguments",
    [
        dict(verbose=True),
        dict(seed=np.int64(3)),
        dict(tensorboard_log=Path("somewhere")),
        dict(device=th.device("cpu")),
        dict(policy_kwargs=MappingProxyType(dict(net_arch=[4]))),
        dict(optimize_memory_usage=0),
        dict(stats_window_size=None),
        dict(learning_starts=4.0),
        dict(learning_starts=np.float32(4)),
        dict(learning_rate=np.float32(1e-3)),
        dict(learning_rate=np.float16(1e-3), actor_learning_rate=np.float32(1e-4)),
        dict(learning_rate=lambda _: np.float32(1e-3), actor_learning_rate=1),
    ],
)
def test_equivalent_values_are_taken(arguments, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    model = make(**dict(learning_starts=4) | arguments).learn(6)
    assert repr(model.learning_starts) == "4"
    assert model._n_updates == 2
    population = Population("MlpPolicy", "Pendulum-v1", 2, **SMALL | dict(learning_starts=4) | arguments).learn(2 * 6)
    assert repr(population.learning_starts) == "8"


def test_seeds_of_numpy_are_those_of_python(saved):
    firsts = [make(seed=seed, learning_starts=4).learn(6).predict(np.ones(3))[0] for seed in (3, np.int64(3))]
    assert firsts[0] == firsts[1]
    CGP.load(saved, env="Pendulum-v1", seed=np.int64(3)).set_random_seed(np.int64(4))
    Population("MlpPolicy", "Pendulum-v1", 2, **SMALL | dict(seed=np.int64(3), learning_starts=2)).learn(8)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("activation_fn", "relu", "a class, such as torch.nn.ReLU"),
        ("activation_fn", th.nn.ReLU(), "a class, such as torch.nn.ReLU"),
        ("optimizer_class", "Adam", "a class, such as torch.optim.Adam"),
        ("features_extractor_class", "FlattenExtractor", "a class, such as"),
        ("optimizer_kwargs", 3, "None or a dictionary"),
        ("n_critics", 0, "an integer >= 1"),
        ("net_arch", 64, "None, a list of integers >= 1"),
        ("net_arch", "64", "None, a list of integers >= 1"),
        ("net_arch", [64.0], "None, a list of integers >= 1"),
        ("net_arch", dict(pi=[4]), "None, a list of integers >= 1"),
        ("net_arch", (4, 4), "None, a list of integers >= 1"),
    ],
)
def test_a_wrong_argument_of_the_policy_is_refused_by_name(name, value, allowed):
    message = re.escape(f"The value of `policy_kwargs['{name}']` is {value!r}, but must be {allowed}")
    with pytest.raises(ValueError, match=message):
        make(policy_kwargs={name: value})


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3, lambda *args, **kwargs: Population(*args, 2, **kwargs)])
def test_a_learning_rate_among_the_optimizers_arguments_is_sent_to_the_algorithm(algorithm):
    message = r"`policy_kwargs\['optimizer_kwargs'\]\['lr'\]` is 0.1, but must be left out: give `learning_rate` to the"
    with pytest.raises(ValueError, match=message):
        make(algorithm=algorithm, policy_kwargs=dict(optimizer_kwargs=dict(lr=0.1)))


@pytest.fixture
def float64():
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3, lambda *args, **kwargs: Population(*args, 2, **kwargs)])
def test_another_default_data_type_is_named_as_the_cause(algorithm, saved, float64):
    message = r"`torch.get_default_dtype\(\)` is torch.float64, but must be torch.float32, .* `torch.set_default_dtype"
    with pytest.raises(ValueError, match=message):
        make(algorithm=algorithm)
    with pytest.raises(ValueError, match=message):
        CGP.load(saved)


class Casting(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations).double()


def test_networks_that_compute_in_another_default_data_type_are_taken(float64):
    class Policy(TD3Policy):
        def make_actor(self, features_extractor=None):
            actor = super().make_actor(features_extractor)
            actor.mu.append(ToFloat32())
            return actor

    class ToFloat32(th.nn.Module):
        def forward(self, actions):
            return actions.float()

    make(Policy, algorithm=GuardedTD3, policy_kwargs=dict(net_arch=[4], features_extractor_class=Casting))


class Images(gym.Env):
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, space):
        self.observation_space = space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


@pytest.mark.parametrize("shape", [(8, 8, 3), (36, 35, 1), (3, 20, 20)], ids=str)
@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3])
def test_images_that_are_too_small_for_sb3s_network_are_refused_with_the_remedy(algorithm, policy, shape):
    space = gym.spaces.Box(0, 255, shape, np.uint8)
    env = Images(space if policy == "CnnPolicy" else gym.spaces.Dict(camera=space))
    shape = shape if shape[0] == 3 else (shape[2], *shape[:2])
    message = rf"`observation_space` is Box\(0, 255, {re.escape(str(shape))}, uint8\), .* at least 36 x 36 pixels .*Resize"
    with pytest.raises(ValueError, match=message):
        make(policy, env, algorithm, policy_kwargs={})


def test_the_smallest_images_are_taken():
    make("CnnPolicy", Images(gym.spaces.Box(0, 255, (36, 36, 1), np.uint8)), policy_kwargs={})


@pytest.mark.parametrize(
    "arguments",
    [
        dict(net_arch=[]),
        dict(net_arch=dict(pi=[4], qf=[])),
        dict(net_arch=dict(pi=(4,), qf=(np.int64(4),))),
        dict(net_arch=dict(pi=[4], qf=[4], vf=[4])),
        dict(activation_fn=lambda: th.nn.LeakyReLU(0.1)),
        dict(optimizer_class=th.optim.SGD, optimizer_kwargs=dict(momentum=0.9)),
    ],
)
def test_valid_arguments_of_the_policy_are_taken(arguments):
    make(policy_kwargs=dict(net_arch=[4]) | arguments, learning_starts=4).learn(8)


@pytest.mark.parametrize("algorithm", [CGP, GuardedTD3])
@pytest.mark.parametrize(
    ("env", "remedy"),
    [
        (None, "only `load` needs none"),
        (3, "the name of a registered environment"),
        ([gym.make], "the name of a registered environment"),
        (lambda: gym.make("Pendulum-v1"), re.escape("which `make_vec_env(function)` makes")),
        (gym.Wrapper, re.escape("write `Wrapper(...)`, with its arguments")),
        (gym.make_vec("Pendulum-v1", num_envs=2), re.escape("which SB3's `make_vec_env(name, n_envs=N)` makes")),
    ],
)
def test_what_is_no_environment_is_refused(algorithm, env, remedy):
    with pytest.raises(ValueError, match=f"The value of `env` is .*, but must be .*{remedy}"):
        algorithm("MlpPolicy", env, **SMALL)


def test_load_and_set_env_take_the_name_of_an_environment(tmp_path):
    model = make_model(seed=0)
    model.save(tmp_path / "model")
    loaded = CGP.load(tmp_path / "model", env="Pendulum-v1")
    assert loaded.get_env().get_attr("spec")[0].id == "Pendulum-v1"
    before = loaded.get_env()
    loaded.set_env("Pendulum-v1")
    assert loaded.get_env() is not before
    loaded.learn(60)
    with pytest.raises(ValueError, match="The value of `env` is 3"):
        loaded.set_env(3)


def test_a_policy_for_dict_observations_is_refused_where_there_are_none():
    with pytest.raises(ValueError, match="`policy` is 'MultiInputPolicy', but must be 'MlpPolicy', or 'CnnPolicy' for images"):
        make("MultiInputPolicy")


class OnePolicy(CGP):
    """Has one class of policies under both names."""

    policy_aliases: ClassVar = {"MlpPolicy": MlpPolicy, "MultiInputPolicy": MlpPolicy}


def test_a_policy_that_takes_the_observations_is_taken_under_any_name():
    make("MlpPolicy", algorithm=OnePolicy)
    make("MultiInputPolicy", policy_kwargs=dict(net_arch=[4], features_extractor_class=FlattenExtractor))


class Extended(CGP):
    """Has an argument more, and gives the policy itself."""

    def __init__(self, env="Pendulum-v1", width=1, _init_setup_model=True, **arguments):
        self.width = width
        super().__init__(arguments.pop("policy", "MlpPolicy"), env, _init_setup_model=_init_setup_model, **arguments)


def test_a_subclass_is_named_with_its_own_arguments():
    assert Extended(width=3, **SMALL).width == 3
    with pytest.raises(TypeError, match=r"`Extended` takes no such argument\. Did you mean `width`\?"):
        Extended(widht=3, **SMALL)


class OwnConstructor(TD3):
    """Takes no policy."""

    def __init__(self, env="Pendulum-v1", **arguments):
        super().__init__("MlpPolicy", env, **arguments)


def test_guards_leave_another_algorithms_constructor_as_it_is():
    class Guarded(GuardedAlgorithm, OwnConstructor):
        pass

    Guarded(**SMALL)
    assert "action_noise" in inspect.signature(GuardedTD3).parameters


@pytest.mark.parametrize("other", [TD3, SAC])
def test_a_model_of_another_algorithm_is_refused_with_the_remedy(other, tmp_path):
    # SAC adds to the dictionary
    other("MlpPolicy", "Pendulum-v1", **SMALL | dict(policy_kwargs=dict(net_arch=[4]))).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"`policy` is .* A saved model of another algorithm is loaded by that one's class"):
        CGP.load(tmp_path / "model")


def test_an_argument_that_a_saved_policy_cannot_follow_has_no_remedy_of_another_algorithm(tmp_path):
    make(CGPPolicy).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"`policy` is .*, but must be .* whose actor can propose actions to the selector\.$"):
        CGP.load(tmp_path / "model", cem_start="actor")
