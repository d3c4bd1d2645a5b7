"""A function that is recorded as a CUDA graph: calls before it, streams, and what cannot be recorded."""

import re
import warnings
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pytest
import torch as th
from graph_models import StandIn

from sb3_cgp.fast import cuda_graphs
from sb3_cgp.fast.cuda_graphs import WARM_UP_CALLS, RecordedFunction


def test_a_function_is_called_then_recorded_once_then_replayed(monkeypatch):
    monkeypatch.setattr(cuda_graphs, "Recording", StandIn)
    monkeypatch.setattr(StandIn, "made", 0)

    def double(tensor, nothing):
        return 2 * tensor, None

    call = RecordedFunction()
    for value in range(WARM_UP_CALLS + 3):
        doubled, nothing = call(double, th.full((2,), float(value)), None)
        assert doubled.tolist() == [2.0 * value] * 2
        assert nothing is None
        assert StandIn.made == (value >= WARM_UP_CALLS)
    # Another shape or type than the recorded one
    assert call(double, th.ones(3), None)[0].tolist() == [2.0] * 3
    assert call(double, th.ones(2, dtype=th.long), None)[0].dtype == th.long
    assert StandIn.made == 1
    # What was returned before is not overwritten
    first = call(double, th.ones(2), None)[0]
    call(double, th.zeros(2), None)
    assert first.tolist() == [2.0, 2.0]


class Stream:
    """A stream that remembers what it was told."""

    def __init__(self, name):
        self.name, self.waited_for = name, []

    def wait_stream(self, other):
        self.waited_for.append(other.name)


@pytest.fixture
def make_believe_gpu(monkeypatch):
    """PyTorch's streams and graphs, as far as they are used, without a GPU behind them: carried out at once."""
    streams = {"current": Stream("usual")}
    side = Stream("side")

    @contextmanager
    def stream(entered):
        left, streams["current"] = streams["current"], entered
        yield
        streams["current"] = left

    @contextmanager
    def graph(graph, stream):
        streams["current"], found.is_recording = stream, True
        # As PyTorch does, not in a `finally`
        yield
        streams["current"], found.is_recording = found.usual, False

    found = SimpleNamespace(streams=streams, usual=streams["current"], side=side, is_recording=False)
    monkeypatch.setattr(cuda_graphs, "gpu_of", lambda inputs: th.device("cuda", 0))
    monkeypatch.setattr(cuda_graphs, "_side_stream", lambda gpu: side)
    for name, replacement in {
        "device": lambda gpu: nullcontext(),
        "current_stream": lambda: streams["current"],
        "set_stream": lambda stream: streams.update(current=stream),
        "stream": stream,
        "graph": graph,
        "CUDAGraph": lambda: SimpleNamespace(replay=lambda: None),
        "get_sync_debug_mode": lambda: 0,
        "set_sync_debug_mode": lambda mode: None,
        "default_generators": [th.default_generator],
    }.items():
        monkeypatch.setattr(th.cuda, name, replacement)
    return found


def test_warm_up_calls_run_on_the_side_stream_in_order(make_believe_gpu):
    seen = []

    def function(tensor):
        seen.append(make_believe_gpu.streams["current"].name)
        return (2 * tensor,)

    outputs, waits = cuda_graphs._warm_up(function, (th.ones(1),), th.device("cuda", 0))
    assert (outputs[0].item(), waits, seen) == (2.0, False, ["side"])
    assert make_believe_gpu.side.waited_for == ["usual"]
    assert make_believe_gpu.usual.waited_for == ["side"]


def test_a_synchronization_is_noticed_and_other_warnings_are_passed_on(make_believe_gpu):
    def function(tensor):
        warnings.warn("Synchronization debug mode is a prototype feature and may miss some", stacklevel=1)
        warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
        warnings.warn("something else", stacklevel=1)
        return (tensor,)

    call = RecordedFunction()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        call(function, th.ones(1))
    other, waiting = (str(warning.message) for warning in warned)
    assert other == "something else"
    assert re.match("The host synchronises with the GPU in .*test_cuda_graphs_recording.py, line ", waiting)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(WARM_UP_CALLS):
            call(function, th.ones(1))
    assert call._recording is None


def test_a_recording_is_made_on_the_side_stream(make_believe_gpu):
    seen = []

    def function(tensor, nothing):
        seen.append(make_believe_gpu.streams["current"].name)
        return (2 * tensor,)

    recording = cuda_graphs.Recording(function, (th.ones(1), None))
    assert seen == ["side"]
    assert make_believe_gpu.streams["current"] is make_believe_gpu.usual
    assert recording.fits((th.zeros(1), None))
    assert not recording.fits((th.zeros(1), th.zeros(1)))
    assert not recording.fits((th.zeros(1),))
    # This graph does nothing when replayed: what it returns is as it was recorded
    assert recording.replay((th.zeros(1), None))[0].item() == 2.0
    assert recording._inputs[0].item() == 0.0


def test_what_cannot_be_recorded_is_carried_out(make_believe_gpu):
    def function(tensor):
        if make_believe_gpu.is_recording:
            raise RuntimeError("operation not permitted when stream is capturing\nSearch for it")
        return (2 * tensor,)

    call = RecordedFunction()
    for _ in range(WARM_UP_CALLS):
        call(function, th.ones(1))
    with pytest.warns(UserWarning, match="The reason: operation not permitted when stream is capturing$"):
        assert call(function, th.ones(1))[0].item() == 2.0
    assert make_believe_gpu.streams["current"] is make_believe_gpu.usual
    # Random numbers wait for the end of a recording: another one has ended
    assert not make_believe_gpu.is_recording
    assert call(function, th.full((1,), 3.0))[0].item() == 6.0
    assert call._recording is None
