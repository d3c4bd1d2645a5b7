"""The global random generators, whose states a measurement must not change."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def preserved_random_state(device: th.device) -> Iterator[None]:
    """
    Restore the states of Python's, NumPy's and PyTorch's global generators at the end of a ``with`` block.

    :param device: the device whose generator is restored along with the CPU's
    """
    # The generator of SB3's replay buffers
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    try:
        with th.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002
