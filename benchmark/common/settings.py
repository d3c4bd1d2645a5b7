"""Arguments of CGP that measurements call by a name."""

from typing import Any

# CGP-Light: CEM starts from the actor and evaluates the critic an eighth as often
LIGHT_ARGUMENTS: dict[str, Any] = dict(cem_start="actor", cem_iterations=1, cem_samples=16)
