"""Environments that fail, values that are no numbers, and wrong use that would be silent, or blamed on something else."""

from sb3_cgp.guards.algorithm import GuardedAlgorithm

__all__ = ["GuardedAlgorithm"]
