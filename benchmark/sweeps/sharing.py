"""
Which runs may be agents of one population, and the arguments of each agent.

Methods of CGP are trained as they are. SB3's TD3 and DDPG are CGP with the selector that is the actor alone, which computes
what they compute. Runs of all other algorithms are trained one by one.
"""

import functools
import inspect
import json
from dataclasses import asdict
from typing import Any

from rl_zoo3 import ALGOS
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmark.sweeps.runs import Run
from sb3_cgp import CGP
from sb3_cgp.population.arguments import COMMON, OWN, Arguments, check_supported, merge_arguments
from sb3_cgp.selectors import ActorOnly

# The algorithms whose runs a population can train: CGP, and those that are CGP with these arguments
AS_CGP: dict[str, Arguments] = {
    "cgp": {},
    # SB3 updates the target networks with the actor
    "td3": {"policy_loss": "qgp", "policy_kwargs": {"selector": ActorOnly()}},
    "ddpg": {
        "policy_loss": "qgp",
        "policy_kwargs": {"selector": ActorOnly(), "n_critics": 1},
        "policy_delay": 1,
        # Without smoothing of target actions
        "target_policy_noise": 0.0,
    },
}
# The networks of TD3 and DDPG by default
SB3_NET_ARCH = [400, 300]
# The hyperparameters of rl_zoo3 that concern an environment alone, or become an argument of the algorithm
ZOO = ("policy", "n_timesteps", "noise_type", "noise_std", "env_kwargs", "env_wrapper", "monitor_kwargs")
# The hyperparameters in which the runs of one population may differ
DIFFERENT = (*OWN, "noise_std")
# The fields of a run in which the runs of one population may differ
DIFFERENT_FIELDS = ("method", "settings", "seed", "hyperparams")


def common_settings(run: Run) -> str | None:
    """
    Return what a run has in common with all runs that may be trained in one population with it.

    :param run: the run
    :return: a text that is the same for all of these runs, and for no others; None for a run that is trained alone
    """
    hyperparams = run.hyperparams
    if run.algo not in AS_CGP or not hyperparams.keys() <= {*OWN, *COMMON, *ZOO}:
        return None
    frequency = hyperparams.get("train_freq", 1)
    try:
        check_supported(CGP.policy_aliases.get(hyperparams.get("policy", "")), hyperparams)
        merge_arguments(1, {"train_freq": tuple(frequency) if isinstance(frequency, list) else frequency})
    except ValueError:
        return None
    common = {name: value for name, value in hyperparams.items() if name not in (*DIFFERENT, "n_timesteps")}
    fields = {name: value for name, value in asdict(run).items() if name not in DIFFERENT_FIELDS}
    return json.dumps([fields, common], sort_keys=True)


def agent_arguments(algo: str, hyperparams: dict[str, Any]) -> Arguments:
    """
    Return the arguments of CGP with which it computes what an algorithm computes.

    :param algo: "cgp", "td3" or "ddpg"
    :param hyperparams: the algorithm's arguments, as rl_zoo3 gives them to it
    :return: the arguments, without the policy
    """
    given = {name: value for name, value in hyperparams.items() if name != "policy"}
    if algo == "cgp":
        return given
    own = AS_CGP[algo]
    arguments = _defaults(algo) | given | {name: value for name, value in own.items() if name != "policy_kwargs"}
    policy_kwargs = {"net_arch": SB3_NET_ARCH} | own["policy_kwargs"] | (hyperparams.get("policy_kwargs") or {})
    return arguments | {"policy_kwargs": policy_kwargs, "target_update_interval": arguments["policy_delay"]}


@functools.cache
def _defaults(algo: str) -> Arguments:
    """Return the defaults of SB3's algorithm, which are not CGP's, of the arguments that both have."""
    parameters = inspect.signature({"td3": TD3, "ddpg": DDPG}[algo]).parameters
    return {name: parameter.default for name, parameter in parameters.items() if name in (*OWN, *COMMON)}


def ordinary_model(run: Run, hyperparams: dict[str, Any], agent: CGP) -> BaseAlgorithm:
    """
    Return the model that a run would have had alone, with an agent's parameters.

    :param run: the run
    :param hyperparams: its algorithm's arguments, as rl_zoo3 gives them to it
    :param agent: the agent
    :return: a model of the run's algorithm, without an environment
    """
    if run.algo == "cgp":
        return agent
    algorithm: Any = ALGOS[run.algo]
    model = algorithm(env=None, seed=run.seed, device=agent.device, _init_setup_model=False, **hyperparams)
    # As SB3's `load` does for a model without an environment
    model.observation_space, model.action_space, model.n_envs = agent.observation_space, agent.action_space, 1
    buffer_size, model.buffer_size = model.buffer_size, 1
    model._setup_model()
    model.buffer_size = buffer_size
    parameters, own = agent.get_parameters(), model.get_parameters()
    for name in ("actor.optimizer", "critic.optimizer"):
        # CGP's optimizers are fused, or capturable by CUDA graphs; SB3's count their steps on the host
        state = {key: moments | {"step": moments["step"].cpu()} for key, moments in parameters[name]["state"].items()}
        parameters[name] = {"state": state, "param_groups": own[name]["param_groups"]}
    model.set_parameters(parameters, device=agent.device)
    for name in ("num_timesteps", "_n_updates", "_current_progress_remaining"):
        setattr(model, name, getattr(agent, name))
    return model
