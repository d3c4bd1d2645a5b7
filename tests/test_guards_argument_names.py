"""Arguments that do not exist are refused by name, with the nearest one or the place where they belong."""

import inspect

import pytest
import torch as th
from guarded import SMALL, make
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_cgp import CGP
from sb3_cgp.common.sb3_arguments import constructor_argument_names
from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.fast.policies import MlpPolicy
from sb3_cgp.population import Population

POLICY_ARGUMENTS = ["net_arch", "n_critics", "activation_fn", "optimizer_class", "features_extractor_class", "selector"]


@pytest.mark.parametrize(
    ("given", "similar"),
    [
        ("learning_rat", "learning_rate"),
        ("cem_sample", "cem_samples"),
        ("learning_start", "learning_starts"),
        ("gama", "gamma"),
    ],
)
def test_a_misspelt_argument_of_the_constructor_is_refused_with_the_nearest_one(given, similar):
    message = rf"The value of `{given}` is 3, but `CGP` takes no such argument\. Did you mean `{similar}`\?"
    with pytest.raises(TypeError, match=message):
        make(**{given: 3})


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("total_timesteps", "Give it to `learn`"),
        ("n_timesteps", "Give `total_timesteps` to `learn`"),
        ("n_envs", "Give it to SB3's `make_vec_env`"),
        ("eval_freq", "Give SB3's `EvalCallback`"),
        ("n_sampled_goal", "Give it in `replay_buffer_kwargs`"),
        ("gradient_clip", "gradients are not clipped"),
        ("noise_std", "give `action_noise="),
        ("n_epochs", "It takes action_noise"),
    ],
)
def test_an_argument_that_belongs_elsewhere_is_sent_there(name, remedy):
    with pytest.raises(TypeError, match=f"`CGP` takes no such argument. .*{remedy}"):
        make(**{name: 3})


def test_of_several_unknown_arguments_the_first_has_a_remedy_and_the_others_are_named():
    with pytest.raises(TypeError, match=r"The value of `netarch` is 1, .* It does not take `foo`, `bar` either\."):
        make(netarch=1, foo=2, bar=3)


def test_an_argument_of_the_constructor_is_sent_there_by_learn():
    with pytest.raises(TypeError, match=r"`CGP.learn` takes no such argument\. Give it to the constructor\."):
        make().learn(5, batch_size=3)


def test_an_argument_similar_to_none_is_refused_with_all_names():
    with pytest.raises(TypeError, match=r"`CGP` takes no such argument\. It takes action_noise, .*cem_samples, .*verbose\."):
        make(zzz=1)


@pytest.mark.parametrize("name", POLICY_ARGUMENTS)
def test_an_argument_of_the_policy_is_sent_to_policy_kwargs(name):
    assert name in constructor_argument_names(CGPPolicy)
    with pytest.raises(TypeError, match=f"`{name}` .*`CGP` takes no such argument.*policy_kwargs"):
        make(**{name: 1})


def own_arguments(other):
    """Return the arguments of an algorithm of SB3's that CGP has not."""
    return sorted(constructor_argument_names(other) - constructor_argument_names(CGP))


@pytest.mark.parametrize("other", [TD3, SAC])
def test_every_argument_that_only_another_algorithm_has_gets_a_remedy(other):
    # `support_multi_env` and its like, which SB3's algorithms give to their base class
    internal = constructor_argument_names(OffPolicyAlgorithm) - {"use_sde", "sde_sample_freq", "use_sde_at_warmup"}
    for name in set(own_arguments(other)) - internal:
        with pytest.raises(TypeError, match=r"`CGP` takes no such argument\. Leave it out: "):
            make(**{name: 1})


@pytest.mark.parametrize(
    ("method", "given", "similar"),
    [
        ("learn", "progressbar", "progress_bar"),
        ("learn", "total_timestep", "total_timesteps"),
        ("train_policy", "max_step", "max_steps"),
    ],
)
def test_a_misspelt_argument_of_a_method_is_refused_with_the_nearest_one(method, given, similar):
    message = rf"The value of `{given}` is 5, but `CGP.{method}` takes no such argument\. Did you mean `{similar}`\?"
    with pytest.raises(TypeError, match=message):
        getattr(make(), method)(**{given: 5})


def test_a_misspelt_argument_of_a_populations_learn_is_refused_with_the_nearest_one():
    population = Population("MlpPolicy", "Pendulum-v1", 2, **SMALL)
    with pytest.raises(TypeError, match=r"`Population.learn` takes no such argument\. Did you mean `progress_bar`\?"):
        population.learn(5, progressbar=True)


def test_learn_has_the_signature_of_sb3():
    parameters, of_td3 = (inspect.signature(each.learn).parameters for each in (CGP, TD3))
    assert list(parameters) == list(of_td3)
    defaults = {name: each.default for name, each in of_td3.items()} | {"tb_log_name": "CGP"}
    assert {name: each.default for name, each in parameters.items()} == defaults


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(net_archh=[8]), "`net_archh` is .8., but `CGPPolicy` takes no such argument. Did you mean `net_arch`?"),
        (dict(learning_rate=1), "Give it to `CGP`, outside `policy_kwargs`"),
        (dict(log_std_init=-3), "Leave it out: the actor has no standard deviation"),
        (dict(zzz=1), "It takes activation_fn, .*, share_features_extractor."),
    ],
)
def test_an_unknown_argument_of_the_policy_is_refused_with_a_remedy(arguments, message):
    with pytest.raises(TypeError, match=message.replace("?", r"\?")):
        make(policy_kwargs=arguments)


class OwnForms(MlpPolicy):
    """Takes an argument that no signature names, and a name in the place of `net_arch`."""

    def __init__(self, *args, net_arch="small", **kwargs):
        self.hidden_argument = kwargs.pop("hidden_argument")
        super().__init__(*args, net_arch={"small": [4]}.get(net_arch, net_arch), **kwargs)


def test_a_users_policy_may_take_arguments_of_other_names_and_forms(tmp_path):
    model = make(OwnForms, policy_kwargs=dict(net_arch="small", hidden_argument=7))
    assert model.policy.hidden_argument == 7
    model.save(tmp_path / "model")
    assert CGP.load(tmp_path / "model").policy.hidden_argument == 7


class Extractor(FlattenExtractor):
    """Takes no argument of the name that the policy takes."""

    def __init__(self, observation_space, width=3):
        super().__init__(observation_space)


def test_an_unknown_argument_of_a_features_extractor_is_not_taken_for_the_policys():
    arguments = dict(activation_fn=th.nn.ReLU)
    given = dict(net_arch=[4], features_extractor_class=Extractor, features_extractor_kwargs=arguments, **arguments)
    with pytest.raises(TypeError, match=r"Extractor.__init__\(\) got an unexpected keyword argument 'activation_fn'"):
        make(policy_kwargs=given)


class FailingPolicy(MlpPolicy):
    """Calls a function of its own by a wrong name."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        dict.fromkeys(wrong=1)


def test_an_error_of_a_users_policy_itself_is_not_replaced():
    with pytest.raises(TypeError, match=r"fromkeys\(\) takes no keyword arguments"):
        CGP(FailingPolicy, "Pendulum-v1", **SMALL)
