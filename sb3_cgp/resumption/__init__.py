"""Resume an interrupted training of any of SB3's off-policy algorithms exactly."""

from sb3_cgp.resumption.algorithm import ResumableAlgorithm, resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.declarations import register_restorable
from sb3_cgp.resumption.environments import RestorableEnv
from sb3_cgp.resumption.locks import FolderInUseError

__all__ = [
    "FolderInUseError",
    "RestorableEnv",
    "ResumableAlgorithm",
    "TrainingCheckpointCallback",
    "register_restorable",
    "resumable",
]
