"""What every test shares."""

import pytest
import torch as th


@pytest.fixture(autouse=True)
def _one_thread():
    # The networks of the tests are too small to gain from more, and test processes run side by side
    th.set_num_threads(1)
