"""rl_zoo3's managers of runs that are agents of a population: they make folders, environments and arguments, and no model."""

from typing import Any

from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.vec_env import VecEnv

from sb3_cgp.zoo.resumed_run import ResumedExperiment


class AgentExperiment(ExperimentManager):
    """
    rl_zoo3's manager of an agent's run.

    :param args: the manager's arguments
    :param kwargs: the same by keyword
    """

    # The algorithm's arguments without the environment, after ``setup_experiment``
    arguments: dict[str, Any]

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        # Makes `setup_experiment` call `_load_pretrained_agent` for the model
        self.continue_training = True

    def create_callbacks(self) -> None:
        """Create none: the population has one of each kind for all agents."""

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> Any:
        # The environment of the action space
        env.close()
        self.arguments = hyperparams


class ResumedAgent(AgentExperiment, ResumedExperiment):
    """rl_zoo3's manager of an agent's run that continues."""
