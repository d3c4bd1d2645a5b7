"""
Gradient steps as CUDA graphs: the many small operations of a step are launched by the host as one.

A graph is what a function did on the GPU while it was recorded. Python does not run when it is replayed: nothing may depend
on a value that the host would have to read, and whatever Python decides is fixed.
"""

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch as th

# Real calls before the recording, in which libraries and optimisers allocate what they keep
EAGER_CALLS = 3

Tensors = tuple[th.Tensor | None, ...]


class Recording:
    """
    A CUDA graph of one call of a function.

    :param function: takes tensors, and returns tensors; it is recorded, but not carried out
    :param inputs: its arguments, of the shapes that all calls will have
    :raises RuntimeError: if something in the function cannot be recorded
    """

    def __init__(self, function: Callable[..., Tensors], inputs: Tensors):
        self._inputs = _clones(inputs)
        self._graph = th.cuda.CUDAGraph()
        with th.cuda.graph(self._graph):
            self._outputs = function(*self._inputs)

    def fits(self, inputs: Tensors) -> bool:
        """
        Tell whether the graph can be replayed on these arguments.

        :param inputs: the arguments
        :return: whether they are of the recorded shapes and types
        """
        return len(inputs) == len(self._inputs) and all(map(_are_alike, inputs, self._inputs))

    def replay(self, inputs: Tensors) -> Tensors:
        """
        Carry the function out.

        :param inputs: its arguments
        :return: what it returns
        """
        for recorded, new in zip(self._inputs, inputs, strict=True):
            if recorded is not None and new is not None:
                recorded.copy_(new)
        self._graph.replay()
        # The next replay writes to the same memory
        return _clones(self._outputs)


def _clones(tensors: Sequence[th.Tensor | None]) -> Tensors:
    return tuple(None if tensor is None else tensor.clone() for tensor in tensors)


def _are_alike(tensor: th.Tensor | None, other: th.Tensor | None) -> bool:
    if tensor is None or other is None:
        return tensor is other
    return (tensor.shape, tensor.dtype, tensor.device) == (other.shape, other.dtype, other.device)


class Captured:
    """
    A function of tensors on a GPU that is recorded after a few calls, and replayed from then on.

    It may change other tensors in place, such as parameters, which must stay where they are in memory. Where it cannot be
    recorded, a warning says why, and every call is carried out as usual.

    :param function: takes tensors (or None), and returns a tuple of them
    """

    def __init__(self, function: Callable[..., Tensors]):
        self._function = function
        self._recording: Recording | None = None
        # Falls to zero before the recording
        self._eager_calls_left = EAGER_CALLS
        self._is_refused = False

    def __call__(self, *inputs: th.Tensor | None) -> Tensors:
        """
        Carry the function out.

        :param inputs: its arguments
        :return: what it returns
        """
        # Streams and graphs belong to the GPU that is current
        with _gpu_of(inputs):
            if self._eager_calls_left > 0:
                self._eager_calls_left -= 1
                return _call_on_a_side_stream(self._function, inputs)
            if self._recording is None and not self._is_refused:
                self._record(inputs)
            if self._recording is not None and self._recording.fits(inputs):
                return self._recording.replay(inputs)
            return self._function(*inputs)

    def _record(self, inputs: Tensors) -> None:
        try:
            self._recording = Recording(self._function, inputs)
        except RuntimeError as error:
            self._is_refused = True
            warnings.warn(f"No CUDA graph of this training can be recorded, so that it is slower: {error}", stacklevel=2)


def _gpu_of(inputs: Tensors) -> AbstractContextManager[Any]:
    gpus = [tensor.device for tensor in inputs if tensor is not None and tensor.is_cuda]
    return th.cuda.device(gpus[0]) if gpus else nullcontext()


def _call_on_a_side_stream(function: Callable[..., Tensors], inputs: Tensors) -> Tensors:
    """Call a function as PyTorch's manual has it done before a recording, which may not depend on the default stream."""
    if not any(tensor is not None and tensor.is_cuda for tensor in inputs):
        return function(*inputs)
    usual, side = th.cuda.current_stream(), th.cuda.Stream()
    side.wait_stream(usual)
    with th.cuda.stream(side):
        outputs = function(*inputs)
    usual.wait_stream(side)
    return outputs


class LossWatch:
    """
    Remembers on the device the first step at which a loss was NaN or infinite, to be read later.

    :param names: the losses' names
    :param n_updates: gradient steps so far
    :param device: where the losses are
    """

    def __init__(self, names: Sequence[str], n_updates: int, device: th.device):
        self._names = list(names)
        self._step = th.full((), n_updates, dtype=th.long, device=device)
        # -1 for none
        self._first_bad = th.full((len(self._names),), -1, dtype=th.long, device=device)

    def begin_step(self) -> None:
        """Count a gradient step."""
        self._step += 1

    def see(self, name: str, loss: th.Tensor) -> th.Tensor:
        """
        Look at a loss without reading it.

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
        Read what was seen.

        :raises ValueError: if a loss was NaN or infinite
        """
        for name, step in zip(self._names, self._first_bad.tolist(), strict=True):
            if step >= 0:
                raise ValueError(
                    f"The {name} loss was NaN or infinite at gradient step {step}. "
                    f"The {name} has skipped that step, and every other one with such a loss."
                )


def can_capture(device: th.device) -> bool:
    """
    Tell whether a device has CUDA graphs.

    :param device: the device
    :return: whether it is an NVIDIA GPU
    """
    return device.type == "cuda" and th.version.cuda is not None


def set_capturable(optimizer: th.optim.Optimizer, is_captured: bool, device: th.device) -> None:
    """
    Let a fused Adam take its steps inside a CUDA graph, or outside.

    :param optimizer: the optimiser
    :param is_captured: whether its steps are recorded; its learning rate is a tensor then, which can change all the same
    :param device: the device
    """
    for group in optimizer.param_groups:
        if "capturable" in group:
            group["capturable"] = is_captured
        rate = float(group["lr"])
        group["lr"] = th.tensor(rate, device=device) if is_captured else rate
    skip_step_if(optimizer, None)


def set_learning_rate(optimizer: th.optim.Optimizer, rate: float) -> None:
    """
    Set an optimiser's learning rate, in place where it is a tensor.

    :param optimizer: the optimiser
    :param rate: the learning rate
    """
    for group in optimizer.param_groups:
        if isinstance(group["lr"], th.Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def skip_step_if(optimizer: Any, is_bad: th.Tensor | None) -> None:
    """
    Have a fused optimiser leave everything as it is in its next step, if need be.

    :param optimizer: the optimiser
    :param is_bad: 1 for a step to skip, else 0, on the device; None to skip none
    """
    # The way in which PyTorch's gradient scaler tells it
    optimizer.found_inf = is_bad


def is_capturable(optimizer: th.optim.Optimizer) -> bool:
    """
    Tell whether an optimiser can take its steps inside a CUDA graph, and skip one there.

    :param optimizer: the optimiser
    :return: whether it is a fused Adam
    """
    return isinstance(optimizer, th.optim.Adam) and bool(optimizer.defaults["fused"])
