"""Sweeps and tuning as Optuna studies whose runs many processes execute together."""
