"""The hyperparameters of a training in TensorBoard's tab HParams, for any algorithm of SB3."""

from collections.abc import Sequence
from numbers import Real
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_cgp.common.rules import require
from sb3_cgp.common.sb3_arguments import constructor_argument_names

# Arguments of a constructor that are no hyperparameters
_LEFT_OUT = {"self", "env", "stats_window_size", "tensorboard_log", "verbose", "_init_setup_model"}


def hyperparameters(model: BaseAlgorithm) -> dict[str, str | float]:
    """
    Return the hyperparameters of a model in the types that TensorBoard shows.

    :param model: the model
    :return: the arguments of the model's constructor by name, the algorithm's name and the number of environments. Numbers
        stay numbers. All else is text; that of a schedule has its values at the start and at the end of the training.
    """
    # Of an algorithm whose constructor takes further arguments that are none of its bases'
    declared = getattr(type(model), "hyperparameter_names", None)
    names = set(constructor_argument_names(type(model)) if declared is None else declared) - _LEFT_OUT
    # An argument that the algorithm does not keep as an attribute cannot be read
    values = {name: getattr(model, name) for name in sorted(names) if hasattr(model, name)}
    values |= {"algorithm": type(model), "policy": model.policy_class, "n_envs": model.n_envs}
    # The learning rates in effect: SB3's schedule for every form of the argument, and the actor's own where there is one
    for name, schedule in {"learning_rate": "lr_schedule", "actor_learning_rate": "actor_lr_schedule"}.items():
        if name in values and hasattr(model, schedule):
            values[name] = getattr(model, schedule)
    return {name: _shown(value) for name, value in values.items()}


def _shown(value: Any) -> str | float:
    """
    Convert a value to a number or text.

    :param value: a hyperparameter
    :return: a number, also for a schedule that SB3 made of one; text for another schedule, a function of the progress
        remaining; the name of a class; text for all else. TensorBoard would show True as 1, and would omit None.
    """
    if isinstance(value, dict):
        return ", ".join(f"{name}={_shown(each)}" for name, each in sorted(value.items()))
    if isinstance(value, TrainFreq):
        return f"{value.frequency} {value.unit.value}"
    if isinstance(value, type):
        return value.__name__
    # Not any function: SB3's action noise can be called, too
    if isinstance(value, FloatSchedule | LinearSchedule):
        is_constant = isinstance(getattr(value, "value_schedule", value), ConstantSchedule)
        return float(value(1.0)) if is_constant else f"schedule from {value(1.0):g} to {value(0.0):g}"
    if isinstance(value, Real) and not isinstance(value, bool):
        return float(value)
    text = str(value)
    # An object without a text of its own
    return type(value).__name__ if " object at 0x" in text else text


class HParamsCallback(BaseCallback):
    """
    Fills TensorBoard's tab HParams: a row with the model's hyperparameters, and the last value of each metric in the log.

    It writes once, when the training starts, and has no effect if TensorBoard is not among the outputs of the logger.
    ``rl_zoo3.train --algo cgp --tensorboard-log`` adds it by itself.

    :param metrics: keys of the log. A key that the training does not log is shown without a value.
    :param verbose: Verbosity level: 0 for no output
    :raises ValueError: if ``metrics`` is a string
    """

    def __init__(self, metrics: Sequence[str] = ("eval/mean_reward", "rollout/ep_rew_mean"), verbose: int = 0):
        super().__init__(verbose)
        require(not isinstance(metrics, str), "metrics", metrics, "a sequence of keys, such as ('eval/mean_reward',)")
        self.metrics = metrics

    def _on_training_start(self) -> None:
        # TensorBoard takes the values of metrics from the log; SB3 asks for a number nevertheless
        value = HParam(hyperparameters(self.model), dict.fromkeys(self.metrics, 0.0))
        # Not by `logger.record`, which would write at the next dump of the log: a killed training has none
        for output in self.logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat):
                output.write({"hparams": value}, {"hparams": ()}, self.num_timesteps)

    def _on_step(self) -> bool:
        return True
