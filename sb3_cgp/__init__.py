"""Cross-Entropy Guided Policies (CGP) for Stable-Baselines3."""

from sb3_cgp.algorithm import CGP
from sb3_cgp.common.version import __version__
from sb3_cgp.core.cem import CEM, ActionSelector, Selection
from sb3_cgp.export.policy import ExportedPolicy
from sb3_cgp.fast.policies import CGPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cgp.hparams import HParamsCallback
from sb3_cgp.resumption import RestorableEnv, TrainingCheckpointCallback, register_restorable

__all__ = [
    "CEM",
    "CGP",
    "ActionSelector",
    "CGPPolicy",
    "CnnPolicy",
    "ExportedPolicy",
    "HParamsCallback",
    "MlpPolicy",
    "MultiInputPolicy",
    "RestorableEnv",
    "Selection",
    "TrainingCheckpointCallback",
    "__version__",
    "register_restorable",
]
