"""
Functions of tensors as CUDA graphs: the host launches the many small operations of a function as one.

A graph consists of the operations that a function launched on the GPU while it was recorded. Python does not run when the
graph is replayed: no operation may depend on a value that the host reads, and Python's decisions are fixed.
"""

import functools
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import torch as th

# Calls before the recording, in which libraries and optimizers allocate their memory
WARM_UP_CALLS = 3

Tensors = tuple[th.Tensor | None, ...]
Function = Callable[..., Tensors]


def has_cuda_graphs(device: th.device) -> bool:
    """
    Return whether a device is an NVIDIA GPU, which has CUDA graphs and memory of its own.

    :param device: the device
    :return: whether it is
    """
    return device.type == "cuda" and th.version.cuda is not None


class Recording:
    """
    A CUDA graph of one call of a function.

    :param function: takes tensors, and returns tensors; it is recorded, but not carried out
    :param inputs: its arguments, of the shapes that all calls will have
    :raises RuntimeError: if an operation of the function cannot be recorded
    """

    def __init__(self, function: Function, inputs: Tensors):
        gpu = gpu_of(inputs)
        assert gpu is not None
        self._inputs = clone_all(inputs)
        self._graph = th.cuda.CUDAGraph()
        usual = th.cuda.current_stream()
        try:
            with th.cuda.graph(self._graph, stream=_side_stream(gpu)):
                self._outputs = function(*self._inputs)
        except RuntimeError:
            # PyTorch leaves the recording's stream current, and its generator unusable until a recording succeeds
            th.cuda.set_stream(usual)
            with th.cuda.graph(th.cuda.CUDAGraph(), stream=_side_stream(gpu)):
                clone_all(self._inputs)
            raise

    def fits(self, inputs: Tensors) -> bool:
        """
        Return whether the graph can be replayed on arguments.

        :param inputs: the arguments
        :return: whether their shapes, types and devices are the recorded ones
        """
        return len(inputs) == len(self._inputs) and all(map(_are_alike, inputs, self._inputs))

    def replay(self, inputs: Tensors) -> Tensors:
        """
        Carry the function out.

        :param inputs: its arguments
        :return: its results
        """
        for recorded, new in zip(self._inputs, inputs, strict=True):
            if recorded is not None and new is not None:
                recorded.copy_(new)
        self._graph.replay()
        # The next replay writes to the same memory
        return clone_all(self._outputs)


class RecordedFunction:
    """
    One function of tensors that is recorded on a GPU after a few calls, and replayed from then on.

    The function may change other tensors in place, such as parameters, which must keep their memory. A function that
    synchronises with the host cannot be recorded. The first replay is compared with a real call from the same state and
    random numbers. If a recording fails or differs, a warning says so, and every call is carried out as usual.

    :param list_state: returns the tensors that the function changes in place
    """

    def __init__(self, list_state: Callable[[], Sequence[th.Tensor]] = list):
        self._list_state = list_state
        self._recording: Recording | None = None
        self._warm_up_calls_left = WARM_UP_CALLS
        self._stays_eager = False

    def __call__(self, function: Function, *inputs: th.Tensor | None) -> Tensors:
        """
        Carry the function out.

        :param function: takes tensors (or None), and returns a tuple of them; the same function in every call
        :param inputs: its arguments
        :return: its results
        """
        gpu = gpu_of(inputs)
        # Streams and graphs belong to the current GPU
        with nullcontext() if gpu is None else th.cuda.device(gpu):
            if self._warm_up_calls_left > 0:
                self._warm_up_calls_left -= 1
                outputs, self._stays_eager = _warm_up(function, inputs, gpu)
                return outputs
            if self._recording is None and not self._stays_eager:
                return self._record(function, inputs, gpu)
            if self._recording is not None and self._recording.fits(inputs):
                return self._recording.replay(inputs)
            return function(*inputs)

    def _record(self, function: Function, inputs: Tensors, gpu: th.device | None) -> Tensors:
        """Record the function, carry it out both ways, and keep the recording if the results agree."""
        try:
            recording = Recording(function, inputs)
        except RuntimeError as error:
            reason = str(error.__context__ or error).partition("\n")[0]
            warnings.warn(f"A step cannot be recorded as a CUDA graph, and is slower. The reason: {reason}", stacklevel=2)
            self._stays_eager = True
        # Outside of the handler, in which the error would hold the failed recording's memory and be chained to a later error
        if self._stays_eager:
            return function(*inputs)
        generator = th.default_generator if gpu is None else th.cuda.default_generators[gpu.index]
        random_state, before = generator.get_state(), clone_all(self._list_state())
        outputs = clone_all(function(*inputs))
        after = clone_all(self._list_state())
        restore_all(self._list_state(), before)
        generator.set_state(random_state)
        replayed_outputs = recording.replay(inputs)
        state = self._list_state()
        zeros = tuple(None if output is None else th.zeros_like(output) for output in outputs)
        if all(map(_changed_alike, (*state, *replayed_outputs), (*after, *outputs), (*before, *zeros))):
            self._recording = recording
            return replayed_outputs
        message = "The CUDA graph of a step does not do what the step does: steps are carried out one operation at a time."
        warnings.warn(f"{message} Please report it, with the versions of PyTorch and CUDA.", stacklevel=2)
        restore_all(state, after)
        self._stays_eager = True
        return outputs


def gpu_of(inputs: Tensors) -> th.device | None:
    """
    Return the GPU on which arguments lie.

    :param inputs: the arguments
    :return: the device of the first tensor on a GPU; None if there is none
    """
    return next((tensor.device for tensor in inputs if tensor is not None and tensor.is_cuda), None)


def clone_all(tensors: Sequence[th.Tensor | None]) -> Tensors:
    """
    Clone tensors.

    :param tensors: the tensors, or None
    :return: their clones
    """
    return tuple(None if tensor is None else tensor.clone() for tensor in tensors)


def restore_all(tensors: Sequence[th.Tensor], values: Tensors) -> None:
    """
    Copy values into tensors, in place.

    :param tensors: the tensors
    :param values: their values; None leaves a tensor as it is
    """
    with th.no_grad():
        for tensor, value in zip(tensors, values, strict=True):
            if value is not None:
                tensor.copy_(value)


def _are_alike(tensor: th.Tensor | None, other: th.Tensor | None) -> bool:
    if tensor is None or other is None:
        return tensor is other
    return (tensor.shape, tensor.dtype, tensor.device) == (other.shape, other.dtype, other.device)


def _changed_alike(tensor: th.Tensor | None, other: th.Tensor | None, start: th.Tensor | None) -> bool:
    """Return whether two tensors have changed alike from a start. Rounding may differ, which Adam magnifies close to 0."""
    if tensor is None or other is None or start is None:
        return tensor is other
    values, others, starts = (each.detach().double().nan_to_num() for each in (tensor, other, start))
    allowed = 0.1 * (others - starts).norm() + 1e-6 * others.norm()
    return bool((values - others).norm() <= allowed)


@functools.cache
def _side_stream(gpu: th.device) -> th.cuda.Stream:
    # One stream for all recordings, as libraries keep working memory for each stream
    return th.cuda.Stream(gpu)


def _warm_up(function: Function, inputs: Tensors, gpu: th.device | None) -> tuple[Tensors, bool]:
    """
    Call a function on the stream of the recording, as PyTorch's manual requires.

    :return: its results, and whether the function synchronises with the host
    """
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
    synchronizing = [warning for warning in caught if "synchronizing CUDA operation" in str(warning.message)]
    for warning in caught:
        if warning not in synchronizing and "prototype feature" not in str(warning.message):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if len(synchronizing) > 0:
        place = f"{synchronizing[0].filename}, line {synchronizing[0].lineno}"
        message = f"The host synchronises with the GPU in {place}: this cannot be a CUDA graph, and is slower."
        warnings.warn(message, stacklevel=2)
    return outputs, len(synchronizing) > 0
