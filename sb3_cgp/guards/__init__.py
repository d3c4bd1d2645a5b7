"""Errors for failing environments, for NaN and infinite values, and for wrong use that SB3 ignores or misreports."""

from sb3_cgp.guards.algorithm import GuardedAlgorithm

__all__ = ["GuardedAlgorithm"]
