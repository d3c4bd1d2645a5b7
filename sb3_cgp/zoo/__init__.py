"""CGP in rl_zoo3: registration, the search space, and resuming a run."""

from sb3_cgp.zoo.registration import register

__all__ = ["register"]
