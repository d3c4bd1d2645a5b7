"""What every test shares: one thread, and the CPU, so that the same is tested with and without a GPU."""

import signal

import pytest
import torch as th

HAS_GPU = th.cuda.is_available()


@pytest.fixture(scope="session", autouse=True)
def _cpu():
    """Hide the GPU: what computes on "auto" is compared with the CPU's results, often to the bit."""
    with pytest.MonkeyPatch.context() as patch:
        if HAS_GPU:
            # PyTorch counts GPUs once, then or never
            th.cuda.init()
            assert th.cuda.device_count() > 0
        patch.setattr(th.cuda, "is_available", lambda: False)
        # For the processes that tests start
        patch.setenv("CUDA_VISIBLE_DEVICES", "")
        yield


@pytest.fixture(autouse=True)
def _one_thread():
    # The networks of the tests are too small to gain from more, and test processes run side by side
    th.set_num_threads(1)


@pytest.fixture
def gpu(monkeypatch):
    """Show the GPU to a test; without one, skip it."""
    if not HAS_GPU:
        pytest.skip("needs a GPU")
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)


@pytest.fixture
def heeds_interruptions():
    """Have a test and the processes that it starts heed Ctrl-C: what a shell has put into the background ignores it."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)
