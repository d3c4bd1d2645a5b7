"""Vectorised environments of other packages that have no method ``seed``, which SB3 calls."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def warning_of_missing_seed(env: Any, seed: int | None) -> Iterator[None]:
    """
    Warn if the environments that are seeded within the context cannot be.

    :param env: the vectorised environment
    :param seed: the seed
    """
    try:
        yield
    except AttributeError as error:
        # SB3 seeds the environments last. Another object without `seed` is a fault of the environment's own.
        if error.name != "seed" or not any(error.obj is each for each in _layers(env)):
            raise
        kind = type(error.obj)
        warnings.warn(
            f"{kind.__module__}.{kind.__qualname__} has no method `seed`: the random numbers of the environments do not "
            f"follow from `seed={seed}`, so that two trainings with this seed differ. Set the seed where the environments "
            "are made, or give the method `seed(seed)` to a VecEnvWrapper around them.",
            # Of this context's generator, `contextlib` and `set_random_seed`
            stacklevel=4,
        )


def _layers(env: Any) -> Iterator[Any]:
    """Yield a vectorised environment, and those that it wraps."""
    while env is not None:
        yield env
        env = vars(env).get("venv")
