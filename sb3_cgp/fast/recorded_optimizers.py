"""What optimizers and losses need within a CUDA graph: learning rates and checks that the host does not read."""

from collections.abc import Sequence
from typing import Any

import torch as th

# Gradient steps between two checks of the losses, each of which synchronises with the GPU
CHECK_INTERVAL = 100
# Keys of the losses in the log, in the order in which a gradient step returns them
LOSSES = ("critic_loss", "q_value", "actor_loss")


class LossWatch:
    """
    Stores on the device the first gradient step whose loss was NaN or infinite, to be read later.

    :param names: the losses' names
    :param n_updates: number of gradient steps so far
    :param device: the losses' device
    """

    def __init__(self, names: Sequence[str], n_updates: int, device: th.device):
        self._names = list(names)
        self._step = th.full((), n_updates, dtype=th.long, device=device)
        # -1 for none
        self._first_bad = th.full((len(self._names),), -1, dtype=th.long, device=device)

    def begin_step(self) -> None:
        """Count a gradient step."""
        self._step += 1

    @property
    def state(self) -> list[th.Tensor]:
        """The tensors that a step changes in place."""
        return [self._step, self._first_bad]

    def see(self, name: str, loss: th.Tensor) -> th.Tensor:
        """
        Examine a loss without reading it on the host.

        :param name: its name
        :param loss: the loss, a scalar
        :return: 1 if it is NaN or infinite, else 0, on the device
        """
        is_bad = ~loss.detach().isfinite()
        first_bad = self._first_bad[self._names.index(name)]
        first_bad.copy_(th.where(is_bad & (first_bad < 0), self._step, first_bad))
        return is_bad.float()

    def check(self) -> None:
        """
        Read the result on the host.

        :raises ValueError: if a loss was NaN or infinite
        """
        first_bad = self._first_bad.tolist()
        # In place, as graphs write to this memory; the training may go on with other data
        self._first_bad.fill_(-1)
        for name, step in zip(self._names, first_bad, strict=True):
            if step >= 0:
                raise ValueError(
                    f"The {name} loss was NaN or infinite at gradient step {step}. "
                    f"The {name} has skipped that step, and every other one with such a loss."
                )


def is_fused_adam(optimizer: th.optim.Optimizer) -> bool:
    """
    Return whether an optimizer can take its steps inside a CUDA graph, and skip a step there.

    :param optimizer: the optimizer
    :return: whether it was made as a fused Adam
    """
    return isinstance(optimizer, th.optim.Adam) and bool(optimizer.defaults["fused"])


def set_capturable(optimizer: th.optim.Optimizer, rate: th.Tensor | None) -> None:
    """
    Prepare an optimizer for steps inside a CUDA graph, or outside.

    :param optimizer: the optimizer; if it was made as a fused Adam, it becomes one again, whatever state it has loaded
    :param rate: its learning rate inside a graph, a tensor whose value may change; None outside
    """
    for group in optimizer.param_groups:
        if "capturable" in group:
            group["capturable"] = rate is not None
        group["lr"] = float(group["lr"]) if rate is None else rate
        if is_fused_adam(optimizer):
            group.update(fused=True, foreach=None)
            for state in (optimizer.state[parameter] for parameter in group["params"] if parameter in optimizer.state):
                state["step"] = th.as_tensor(state["step"], dtype=th.float32, device=group["params"][0].device)
    skip_step_if(optimizer, None)


def skip_step_if(optimizer: Any, is_bad: th.Tensor | None) -> None:
    """
    Let a fused optimizer skip its next step under a condition on the device.

    :param optimizer: the optimizer
    :param is_bad: 1 for a step to skip, else 0, on the device; None to skip none
    """
    # PyTorch's gradient scaler sets the same attribute
    optimizer.found_inf = is_bad
