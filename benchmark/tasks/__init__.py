"""
Tasks whose values have several maxima in the action (experiment E10). Importing this package registers them in Gymnasium.

- ``RestrictedPendulum-v1``, ``RestrictedReacher-v5``, ``RestrictedHopper-v5``, ``RestrictedHalfCheetah-v5``: Gymnasium's tasks
  of these names, in which half of the actions have no effect (:class:`~benchmark.tasks.zones.AllowedZones`).
- ``KnownMaxima-v0``, ``KnownMaxima2D-v0``, ``KnownMaxima3D-v0``, ``KnownMaxima6D-v0``: one step, with maxima of known
  positions and heights in 1, 2, 3 or 6 action dimensions (:class:`~benchmark.tasks.landscape.KnownMaxima`).
"""

from benchmark.tasks.registration import register_tasks

register_tasks()
