"""
Tasks whose values have several maxima in the action (experiment E10). Importing this package registers them in Gymnasium.

- ``RestrictedPendulum-v1``, ``RestrictedReacher-v5``, ``RestrictedHopper-v5``, ``RestrictedHalfCheetah-v5``: Gymnasium's tasks
  of these names, in which half of the actions have no effect (:class:`~benchmark.tasks.zones.AllowedZones`).
- ``KnownMaxima-v0``: one step, with maxima of known positions and heights (:class:`~benchmark.tasks.landscape.KnownMaxima`).
"""

from benchmark.tasks.registration import register_tasks

register_tasks()
