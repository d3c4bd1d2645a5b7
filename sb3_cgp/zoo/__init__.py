"""CGP in rl_zoo3: registration, the search space for Optuna, and resuming a run. It needs the extra ``zoo``."""

from sb3_cgp.zoo.registration import register

__all__ = ["register"]
