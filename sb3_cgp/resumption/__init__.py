"""Resume an interrupted training of any of SB3's off-policy algorithms exactly."""

from sb3_cgp.resumption.algorithm import ResumableAlgorithm, resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.resumption.declarations import register_restorable
from sb3_cgp.resumption.environments import RestorableEnv
from sb3_cgp.resumption.locks import FolderInUseError
from sb3_cgp.resumption.replayed import ReplayedEnv, replayed

__all__ = [
    "FolderInUseError",
    "ReplayedEnv",
    "RestorableEnv",
    "ResumableAlgorithm",
    "TrainingCheckpointCallback",
    "register_restorable",
    "replayed",
    "resumable",
]
