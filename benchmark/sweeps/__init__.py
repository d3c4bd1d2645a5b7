"""Sweeps and tuning as Optuna studies that many processes work off together."""
