"""All guards in one class, to be mixed into an off-policy algorithm of SB3's."""

from sb3_cgp.guards.arguments import ArgumentGuard
from sb3_cgp.guards.construction import ConstructionGuard
from sb3_cgp.guards.dummy_vec_env import DummyVecEnvGuard
from sb3_cgp.guards.episodes import EpisodeGuard
from sb3_cgp.guards.explanations import ExplanationGuard
from sb3_cgp.guards.learning_starts import LearningStartsGuard
from sb3_cgp.guards.networks import NetworkGuard
from sb3_cgp.guards.normalisation import NormalisationGuard
from sb3_cgp.guards.parts import PartsGuard
from sb3_cgp.guards.paths import PathGuard
from sb3_cgp.guards.seeds import SeedGuard
from sb3_cgp.guards.transitions import TransitionGuard
from sb3_cgp.guards.workers import WorkerGuard


class CommonGuards(
    PathGuard,
    ConstructionGuard,
    ArgumentGuard,
    SeedGuard,
    WorkerGuard,
    ExplanationGuard,
    DummyVecEnvGuard,
    PartsGuard,
    # Before EpisodeGuard, whose `_setup_learn` resets the environment: the first observations are checked after that
    TransitionGuard,
    EpisodeGuard,
    LearningStartsGuard,
):
    """The guards that populations have too, whose agents have tried their networks one by one, and no ``VecNormalize``."""


class GuardedAlgorithm(CommonGuards, NormalisationGuard, NetworkGuard):
    """
    An algorithm that notices faults of environments and wrong use, and names them or does the right thing.

    It comes before an algorithm among a class's bases: ``class GuardedTD3(GuardedAlgorithm, TD3)``. Each base is a guard of
    its own, and works without the others.
    """
