"""Sweeps and tuning as Optuna studies whose runs many processes execute together."""

from sb3_cgp.common.extras import require_from_extra

require_from_extra("pydantic", "sweeps", "A sweep")
