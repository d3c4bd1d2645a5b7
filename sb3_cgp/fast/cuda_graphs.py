"""
Gradient steps as CUDA graphs: the many small operations of a step are launched by the host as one.

A graph is what a function did on the GPU while it was recorded. Python does not run when it is replayed: nothing may depend
on a value that the host would have to read, and whatever Python decides is fixed.
"""

import functools
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
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
        gpu = _gpu_of(inputs)
        assert gpu is not None
        self._inputs = _clones(inputs)
        self._graph = th.cuda.CUDAGraph()
        usual = th.cuda.current_stream()
        try:
            with th.cuda.graph(self._graph, stream=_side_stream(gpu)):
                self._outputs = function(*self._inputs)
        except RuntimeError:
            # PyTorch leaves the recording's stream in place, and no random numbers outside of recordings until one succeeds
            th.cuda.set_stream(usual)
            with th.cuda.graph(th.cuda.CUDAGraph(), stream=_side_stream(gpu)):
                _clones(self._inputs)
            raise

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
    One function of tensors that is recorded on a GPU after a few calls, and replayed from then on.

    It may change other tensors in place, such as parameters, which must stay where they are in memory. A function that makes
    the host wait for the GPU cannot be recorded, and the first replay is compared with a real call, from the same state and
    random numbers. Where a recording cannot be had or trusted, a warning says so, and every call is carried out as usual.

    :param list_state: lists the tensors that the function changes in place
    """

    def __init__(self, list_state: Callable[[], Sequence[th.Tensor]] = list):
        self._list_state = list_state
        self._recording: Recording | None = None
        self._eager_calls_left = EAGER_CALLS
        self._stays_eager = False

    def __call__(self, function: Callable[..., Tensors], *inputs: th.Tensor | None) -> Tensors:
        """
        Carry the function out.

        :param function: takes tensors (or None), and returns a tuple of them; the same in every call
        :param inputs: its arguments
        :return: what it returns
        """
        gpu = _gpu_of(inputs)
        # Streams and graphs belong to the GPU that is current
        with nullcontext() if gpu is None else th.cuda.device(gpu):
            if self._eager_calls_left > 0:
                self._eager_calls_left -= 1
                outputs, self._stays_eager = _rehearse(function, inputs, gpu)
                return outputs
            if self._recording is None and not self._stays_eager:
                return self._record(function, inputs, gpu)
            if self._recording is not None and self._recording.fits(inputs):
                return self._recording.replay(inputs)
            return function(*inputs)

    def _record(self, function: Callable[..., Tensors], inputs: Tensors, gpu: th.device | None) -> Tensors:
        """Record the function, carry it out both ways, and keep the recording if they agree."""
        try:
            recording = Recording(function, inputs)
        except RuntimeError as error:
            reason = str(error.__context__ or error).partition("\n")[0]
            warnings.warn(f"A step cannot be recorded as a CUDA graph, and is slower. The reason: {reason}", stacklevel=2)
            self._stays_eager = True
        # Not in the handler, where the error would keep the failed recording's memory, and join the error of a step that fails
        if self._stays_eager:
            return function(*inputs)
        generator = th.default_generator if gpu is None else th.cuda.default_generators[gpu.index]
        random_state, before = generator.get_state(), _clones(self._list_state())
        outputs = _clones(function(*inputs))
        after = _clones(self._list_state())
        _restore(self._list_state(), before)
        generator.set_state(random_state)
        replayed_outputs = recording.replay(inputs)
        state = self._list_state()
        zeros = tuple(None if output is None else th.zeros_like(output) for output in outputs)
        if all(map(_have_changed_alike, (*state, *replayed_outputs), (*after, *outputs), (*before, *zeros))):
            self._recording = recording
            return replayed_outputs
        message = "The CUDA graph of a step does not do what the step does: steps are carried out one operation at a time."
        warnings.warn(f"{message} Please report it, with the versions of PyTorch and CUDA.", stacklevel=2)
        _restore(state, after)
        self._stays_eager = True
        return outputs


def _restore(tensors: Sequence[th.Tensor], values: Tensors) -> None:
    with th.no_grad():
        for tensor, value in zip(tensors, values, strict=True):
            if value is not None:
                tensor.copy_(value)


def _have_changed_alike(tensor: th.Tensor | None, other: th.Tensor | None, start: th.Tensor | None) -> bool:
    """Whether two tensors that were equal have changed alike; rounding may differ, and Adam magnifies what is close to 0."""
    if tensor is None or other is None or start is None:
        return tensor is other
    values, others, starts = (each.detach().double().nan_to_num() for each in (tensor, other, start))
    allowed = 0.1 * (others - starts).norm() + 1e-6 * others.norm()
    return bool((values - others).norm() <= allowed)


def _gpu_of(inputs: Tensors) -> th.device | None:
    return next((tensor.device for tensor in inputs if tensor is not None and tensor.is_cuda), None)


@functools.cache
def _side_stream(gpu: th.device) -> th.cuda.Stream:
    # One for all, as libraries keep working memory for each
    return th.cuda.Stream(gpu)


def _rehearse(function: Callable[..., Tensors], inputs: Tensors, gpu: th.device | None) -> tuple[Tensors, bool]:
    """Call a function where it will be recorded, as PyTorch's manual asks for, and tell whether the host waits for the GPU."""
    if gpu is None:
        return function(*inputs), False
    usual, side = th.cuda.current_stream(), _side_stream(gpu)
    mode = th.cuda.get_sync_debug_mode()
    side.wait_stream(usual)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        th.cuda.set_sync_debug_mode("warn")
        try:
            with th.cuda.stream(side):
                outputs = function(*inputs)
        finally:
            th.cuda.set_sync_debug_mode(mode)
    usual.wait_stream(side)
    waits = [warning for warning in caught if "synchronizing CUDA operation" in str(warning.message)]
    for warning in caught:
        if warning not in waits and "prototype feature" not in str(warning.message):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if len(waits) > 0:
        place = f"{waits[0].filename}, line {waits[0].lineno}"
        warnings.warn(f"The host waits for the GPU in {place}: this cannot be a CUDA graph, and is slower.", stacklevel=2)
    return outputs, len(waits) > 0


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

    @property
    def state(self) -> list[th.Tensor]:
        """What a step changes in place."""
        return [self._step, self._first_bad]

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
        first_bad = self._first_bad.tolist()
        # In place, where graphs write to; mended data may be trained on
        self._first_bad.fill_(-1)
        for name, step in zip(self._names, first_bad, strict=True):
            if step >= 0:
                raise ValueError(
                    f"The {name} loss was NaN or infinite at gradient step {step}. "
                    f"The {name} has skipped that step, and every other one with such a loss."
                )


def can_capture(device: th.device) -> bool:
    """
    Tell whether a device has CUDA graphs, and a memory of its own.

    :param device: the device
    :return: whether it is an NVIDIA GPU
    """
    return device.type == "cuda" and th.version.cuda is not None


def set_capturable(optimizer: th.optim.Optimizer, rate: th.Tensor | None) -> None:
    """
    Let an optimiser take its steps inside a CUDA graph, or outside.

    :param optimizer: the optimiser; if it was made as a fused Adam, it becomes one again, whatever was loaded into it
    :param rate: the tensor that is its learning rate inside a graph, and can change there; None outside
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


def set_learning_rate(optimizer: th.optim.Optimizer, rate: float, captured_rate: th.Tensor | None) -> None:
    """
    Set an optimiser's learning rate.

    :param optimizer: the optimiser
    :param rate: the learning rate
    :param captured_rate: the tensor that graphs read it from; None outside of graphs
    """
    if captured_rate is not None:
        captured_rate.fill_(rate)
    for group in optimizer.param_groups:
        # Somebody else may have put a number in the tensor's place
        group["lr"] = rate if captured_rate is None else captured_rate


def skip_step_if(optimizer: Any, is_bad: th.Tensor | None) -> None:
    """
    Have a fused optimiser leave everything as it is in its next step, if need be.

    :param optimizer: the optimiser
    :param is_bad: 1 for a step to skip, else 0, on the device; None to skip none
    """
    # The way in which PyTorch's gradient scaler tells it
    optimizer.found_inf = is_bad


def is_fused_adam(optimizer: th.optim.Optimizer) -> bool:
    """
    Tell whether an optimiser can take its steps inside a CUDA graph, and skip one there.

    :param optimizer: the optimiser
    :return: whether it was made as a fused Adam
    """
    return isinstance(optimizer, th.optim.Adam) and bool(optimizer.defaults["fused"])
