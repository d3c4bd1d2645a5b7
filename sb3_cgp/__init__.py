"""Cross-Entropy Guided Policies (CGP) for Stable-Baselines3."""

from pathlib import Path

from sb3_cgp.cem import CEM, ActionSelector, Selection
from sb3_cgp.cgp import CGP
from sb3_cgp.exported import ExportedPolicy
from sb3_cgp.policies import CGPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

__all__ = [
    "CEM",
    "CGP",
    "ActionSelector",
    "CGPPolicy",
    "CnnPolicy",
    "ExportedPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "Selection",
    "__version__",
]
