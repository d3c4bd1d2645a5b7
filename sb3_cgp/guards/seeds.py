"""Vectorised environments of other packages that have no method ``seed``, which SB3 calls."""

import warnings
from collections.abc import Iterator
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class SeedGuard(OffPolicyAlgorithm):
    """An algorithm that takes environments which cannot be seeded, and says so."""

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of all random generators, as SB3 does, and warn if that of the environments cannot be set.

        :param seed: the seed
        """
        # Python's random generator takes no integer of NumPy's
        seed = None if seed is None else int(seed)
        try:
            super().set_random_seed(seed)
        except AttributeError as error:
            # SB3 seeds the environments last. Another object without `seed` is a fault of the environment's own.
            if error.name != "seed" or not any(error.obj is each for each in _layers(self.env)):
                raise
            kind = type(error.obj)
            warnings.warn(
                f"{kind.__module__}.{kind.__qualname__} has no method `seed`: the random numbers of the environments do not "
                f"follow from `seed={seed}`, so that two trainings with this seed differ. Set the seed where the environments "
                "are made, or give the method `seed(seed)` to a VecEnvWrapper around them.",
                stacklevel=2,
            )


def _layers(env: Any) -> Iterator[Any]:
    """Yield a vectorised environment, and those that it wraps."""
    while env is not None:
        yield env
        env = vars(env).get("venv")
