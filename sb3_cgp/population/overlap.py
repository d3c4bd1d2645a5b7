"""Gradient steps of a population while its environments take their step."""

from collections.abc import Callable
from typing import Any, ClassVar

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_cgp.common.rules import require
from sb3_cgp.population.training import PopulationTraining


class OverlappedTraining(PopulationTraining):
    """
    The part of :class:`~sb3_cgp.population.algorithm.Population` that overlaps gradient steps with the environments' steps.

    In Algorithm 2 a step's transition is stored before the gradient step, which may sample it. With ``overlap``, the gradient
    steps are taken when the actions have been sent to the environments, so that they cannot sample the newest transition.
    """

    # SB3's wrappers can be neither copied nor pickled. The next rollout makes a new one.
    TRANSIENT: ClassVar[tuple[str, ...]] = ("_overlapping_env",)
    overlap: bool = False
    _overlapping_env: "_OverlappingEnv | None" = None
    # Whether the gradient steps that SB3's loop would take after this rollout have been taken
    _has_trained_ahead: bool = False

    def _check_overlap(self) -> None:
        """
        Check that gradient steps follow every step of the environments, if they are to overlap.

        :raises ValueError: if they do not
        """
        follows = self.train_freq == TrainFreq(1, TrainFrequencyUnit.STEP) and self.gradient_steps > 0
        require(isinstance(self.overlap, bool), "overlap", self.overlap, "True or False")
        allowed = "False unless `train_freq` is 1 and `gradient_steps` is at least 1"
        require(follows or not self.overlap, "overlap", self.overlap, allowed)

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        Take a step of all environments, see SB3's method, and with ``overlap`` the gradient steps at the same time.

        :param env: The training environment
        :param callback: Callback that will be called at each step (and at the beginning and end of the rollout)
        :param args: the further arguments of SB3's method
        :param kwargs: the further arguments of SB3's method
        :return: the numbers of steps and episodes, and whether to go on
        """
        # A callback may have ended the last training before SB3's loop reached `train`
        self._has_trained_ahead = False
        if self.overlap:
            if self._overlapping_env is None or self._overlapping_env.venv is not env:
                self._overlapping_env = _OverlappingEnv(env, self._train_ahead)
            env = self._overlapping_env
        return super().collect_rollouts(env, callback, *args, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Do gradient steps, unless they were taken while the environments took their step.

        :param gradient_steps: number of gradient steps
        :param batch_size: number of transitions in an agent's minibatch
        :raises ValueError: if all agents have failed
        """
        if self._has_trained_ahead:
            self._has_trained_ahead = False
        else:
            super().train(gradient_steps, batch_size)

    def _train_ahead(self) -> None:
        """Do the gradient steps that SB3's loop would do after this step of the environments."""
        assert self.replay_buffer is not None
        n_before = self.num_timesteps
        # The number and the progress that SB3's loop would have then
        self.num_timesteps += self.n_envs
        try:
            if self.num_timesteps > self.learning_starts and self.replay_buffer.size() > 0:
                self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
                self.train(self.gradient_steps, self.batch_size)
                self._has_trained_ahead = True
        finally:
            self.num_timesteps = n_before


class _OverlappingEnv(VecEnvWrapper):
    """
    Environments that call a function while they take a step.

    :param venv: the environments
    :param meanwhile: the function
    """

    def __init__(self, venv: VecEnv, meanwhile: Callable[[], None]):
        super().__init__(venv)
        self.meanwhile = meanwhile

    def reset(self) -> VecEnvObs:
        """
        Reset the environments.

        :return: observations
        """
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """
        Call the function, and wait for the step.

        :return: observations, rewards, ends of episodes and infos
        """
        try:
            self.meanwhile()
        finally:
            # After an error too: the next step would take these replies for its own
            returned = self.venv.step_wait()
        return returned
