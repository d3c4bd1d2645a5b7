"""Optuna's search space for CGP, and the conversion of its parameters into hyperparameters."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise

if TYPE_CHECKING:
    import optuna

# One categorical parameter for the pair, because `policy_loss=None` excludes offline training.
VARIANTS: dict[str, dict[str, str | None]] = {
    "cgp-online": {"policy_loss": "cgp", "policy_training": "online"},
    "cgp-offline": {"policy_loss": "cgp", "policy_training": "offline"},
    "qgp-online": {"policy_loss": "qgp", "policy_training": "online"},
    "qgp-offline": {"policy_loss": "qgp", "policy_training": "offline"},
    # Overrides an `inference` of the YAML entry, and a start from the actor, which would not exist
    "cem": {"policy_loss": None, "policy_training": "online", "inference": "cem", "cem_start": "prior"},
}


def sample_cgp_params(trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sample hyperparameters for CGP. Every sample is valid.

    Every trial samples all parameters, because Optuna's multivariate TPE models only search spaces without conditions.

    rl_zoo3 scores a trial by its last evaluation. An offline variant trains its policy after the last environment step, so
    that its score is that of CEM if the policy converges before the next evaluation is due.

    :param trial: Optuna's trial
    :param n_actions: number of action dimensions, for the action noise
    :param n_envs: number of environments; unused
    :param additional_args: ``using_her_replay_buffer``, a bool; ``her_kwargs``, the arguments of a ``HerReplayBuffer``; and
        optionally ``fixed``, hyperparameters that replace sampled ones
    :return: arguments for CGP
    """
    from rl_zoo3.hyperparams_opt import sample_her_params

    fixed = additional_args.get("fixed", {})
    trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True)
    # From 2**5=32 to 2**9=512: the time of a gradient step grows with batch size times samples
    trial.suggest_int("batch_size_pow", 5, 9)
    trial.suggest_float("learning_rate", 1e-5, 0.002, log=True)
    trial.suggest_float("actor_learning_rate", 1e-5, 0.002, log=True)
    trial.suggest_int("train_freq", 1, 10)
    trial.suggest_int("subsample_steps", 1, 4)
    trial.suggest_float("tau", 0.001, 0.08, log=True)
    trial.suggest_int("policy_delay", 1, 4)
    trial.suggest_int("target_update_interval", 1, 4)
    trial.suggest_float("target_policy_noise", 0.0, 0.5)
    trial.suggest_float("target_noise_clip", 0.1, 1.0)
    trial.suggest_categorical("noise_type", ["none", "normal", "ornstein-uhlenbeck"])
    trial.suggest_float("noise_std", 0.0, 0.5)
    trial.suggest_categorical("net_arch", ["small", "medium", "big"])

    trial.suggest_int("cem_iterations", 1, 5)
    # From 2**4=16 to 2**7=128
    trial.suggest_int("cem_samples_pow", 4, 7)
    trial.suggest_float("cem_elite_fraction", 0.02, 0.5, log=True)
    trial.suggest_categorical("cem_result", ["best", "mean"])
    trial.suggest_categorical("cem_start", ["prior", "actor"])
    trial.suggest_float("cem_actor_fraction", 0.0, 1.0)
    trial.suggest_float("cem_actor_std", 0.05, 1.0, log=True)
    trial.suggest_categorical("variant", list(VARIANTS))

    if additional_args["using_her_replay_buffer"]:
        her_kwargs = sample_her_params(trial, {}, additional_args["her_kwargs"])
    else:
        her_kwargs = {}

    # From the trial's parameters alone, as under `--trial-id`, so that the two agree
    hyperparams = convert_cgp_params(trial.params, fixed)
    hyperparams["action_noise"] = _action_noise(hyperparams.pop("noise_type"), hyperparams.pop("noise_std"), n_actions)
    # Display the values of the hyperparameters
    for name in ("gamma", "batch_size", "gradient_steps", "cem_samples", "cem_elites", "policy_loss", "policy_training"):
        trial.set_user_attr(name, fixed.get(name, hyperparams[name]))
    # The user's other arguments of the HerReplayBuffer, too
    return hyperparams | her_kwargs


def convert_cgp_params(sampled_params: dict[str, Any], fixed: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """
    Convert a trial's parameters into hyperparameters of a YAML file, which has ``noise_type`` and ``noise_std``.

    Fixed hyperparameters leave the parameters as they are, since Optuna allows no other choices in a study that has begun.

    :param sampled_params: the parameters that :func:`sample_cgp_params` suggested
    :param fixed: hyperparameters that the caller will put in place of these
    :return: hyperparameters that are valid together with the fixed ones: a sampled variant that these contradict gives way to
        the one most like it, the elites are a fraction of fixed samples, and the samples are not fewer than fixed elites
    """
    from rl_zoo3.hyperparams_opt import convert_offpolicy_params

    fixed = fixed or {}
    # Values that are no numbers are refused when a model is made
    counts = {name: value for name, value in fixed.items() if isinstance(value, int)}
    hyperparams = convert_offpolicy_params(sampled_params)
    hyperparams.update(_fitting_variant(hyperparams.pop("variant"), fixed))
    sampled = 2 ** hyperparams.pop("cem_samples_pow")
    hyperparams["cem_samples"] = counts.get("cem_samples", max(sampled, counts.get("cem_elites", 1)))
    # At least one, and never more than there are samples
    hyperparams["cem_elites"] = max(round(hyperparams.pop("cem_elite_fraction") * hyperparams["cem_samples"]), 1)
    if hyperparams["noise_type"] == "none":
        # rl_zoo3 has no value that removes the noise of a YAML entry, hence a standard deviation of 0
        hyperparams.update(noise_type="normal", noise_std=0.0)
    her_kwargs = {name: hyperparams.pop(name) for name in ("n_sampled_goal", "goal_selection_strategy") if name in hyperparams}
    if her_kwargs:
        hyperparams["replay_buffer_kwargs"] = her_kwargs
    return hyperparams


def _fitting_variant(sampled: str, fixed: Mapping[str, Any]) -> dict[str, str | None]:
    """
    Return the hyperparameters of a variant that fixed ones do not contradict.

    :param sampled: the sampled variant
    :param fixed: the fixed hyperparameters
    :return: the variant that has most in common with the sampled one, itself if it fits; itself, too, if none fits
    """
    # `inference=None` follows the policy's loss, and contradicts none
    given = {name: value for name, value in fixed.items() if (name, value) != ("inference", None)}
    fitting = [each for each in VARIANTS.values() if all(given.get(name, each[name]) == each[name] for name in each)]
    return max(fitting, key=lambda each: len(each.items() & VARIANTS[sampled].items()), default=VARIANTS[sampled])


def _action_noise(noise_type: str, noise_std: float, n_actions: int) -> ActionNoise:
    """
    Return action noise as rl_zoo3 creates it from the entries of a YAML file.

    :param noise_type: "normal" or "ornstein-uhlenbeck"
    :param noise_std: standard deviation, in units of actions scaled to [-1, 1]
    :param n_actions: number of action dimensions
    :return: the noise
    """
    noise_class = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}[noise_type]
    return noise_class(mean=np.zeros(n_actions), sigma=noise_std * np.ones(n_actions))
