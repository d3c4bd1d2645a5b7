"""The CGP that users get: the core's algorithm with the mixins of the other packages."""

import io
import pathlib
import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_cgp.common.rules import require
from sb3_cgp.core import cgp as core
from sb3_cgp.core.policies import CGPPolicy
from sb3_cgp.diagnostics import DiagnosticsAlgorithm
from sb3_cgp.export.read import ExportedPolicy, load_weights
from sb3_cgp.export.write import export_policy
from sb3_cgp.fast.cuda_graph_algorithm import CudaGraphAlgorithm
from sb3_cgp.fast.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cgp.fast.replay_algorithm import LeanReplayAlgorithm
from sb3_cgp.fast.scoring_algorithm import ScoringAlgorithm
from sb3_cgp.guards.algorithm import GuardedAlgorithm
from sb3_cgp.guards.argument_names import suggests_names
from sb3_cgp.guards.arguments import check_callback
from sb3_cgp.guards.construction import checks_arguments
from sb3_cgp.guards.explanations import explaining_errors
from sb3_cgp.guards.gradients import check_actor_learns, check_gradients
from sb3_cgp.guards.losses import LossGuard
from sb3_cgp.guards.replay_buffer_fit import fit_replay_buffer
from sb3_cgp.resumption.algorithm import ResumableAlgorithm

SelfCGP = TypeVar("SelfCGP", bound="CGP")


class CGP(
    ResumableAlgorithm,
    GuardedAlgorithm,
    DiagnosticsAlgorithm,
    # Records the gradient step of the classes below it
    CudaGraphAlgorithm,
    LossGuard,
    LeanReplayAlgorithm,
    ScoringAlgorithm,
    core.CGP,
):
    """
    Cross-Entropy Guided Policies (CGP).

    Learn Q-functions by TD3's objective, with actions that the Cross-Entropy Method (CEM) selects, and train an actor to
    imitate CEM. After training, an action costs one forward pass of the actor.

    Paper: https://arxiv.org/abs/1903.10605 (Algorithms 1 and 2; the defaults are Appendix B's)

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of the critics, and of the actor unless ``actor_learning_rate`` is given;
        it can be a function of the current progress remaining (from 1 to 0), or a string such as ``"lin_1e-3"`` for a
        linear schedule that ends at 0
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many random steps to take before learning starts; with few, some seeds fail
        in the paper (Appendix A)
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient of the targets and the averaged actor ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default): CEM explores by its own sampling
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the critics.
    :param cem_iterations: number of CEM's iterations
    :param cem_samples: number of actions that CEM samples per state and iteration
    :param cem_elites: number of best samples to which CEM's next iteration is fitted, at most ``cem_samples``
    :param cem_result: "best" acts by the best sample of the last iteration (the paper), "mean" by the elites' mean
    :param cem_start: "prior" draws CEM's first samples from N(0, 1), as the paper does. "actor" takes the actor's action,
        samples around it and samples of the prior, so that fewer suffice: ``cem_start="actor", cem_iterations=1,
        cem_samples=16``, called CGP-Light, evaluates the critic an eighth as often. It needs an actor: with
        ``policy_training="offline"``, only the searches of that training start from it.
    :param cem_actor_fraction: with ``cem_start="actor"``, the share of ``cem_samples`` drawn around the actor's action.
        One sample is that action itself; the others are drawn from the prior.
    :param cem_actor_std: standard deviation of the samples around the actor's action, before tanh
    :param cem_dtype: data type of all layers of the critic but the last one while CEM evaluates it: "auto" (the default),
        which is bfloat16 on processors that multiply it faster than float32, "float32" or "bfloat16". Values, actions and the
        critic's own training are float32 in any case.
    :param cuda_graphs: on a GPU, whether gradient steps and CEM's acting are recorded as CUDA graphs, and the replay buffer
        is kept on the GPU: the same computation in less time. A graph fixes the Python decisions of a user's own selector.
        Has no effect on a CPU or with other observations than ``Box``. With another optimizer than the fused Adam, the
        replay buffer alone is moved.
    :param policy_loss: the actor's loss: "cgp" imitates CEM, "qgp" follows the critic's gradient,
        None trains no actor, so that CEM acts at inference too
    :param policy_training: "online" trains the actor along with the critics, "offline" at the end of ``learn``
        (see :meth:`train_policy`)
    :param inference: what ``predict`` uses: the "actor", the "averaged_actor" (φ' of Algorithm 2) or "cem", the policy's
        selector. None stands for the actor, or for CEM where there is no ``policy_loss``. Rollouts always use CEM. With
        offline training, ``predict`` uses CEM until the policy has been trained, and again during a second ``learn``.
    :param actor_learning_rate: learning rate of the actor, in the same forms. None stands for ``learning_rate``.
    :param policy_delay: The actor is updated once every ``policy_delay`` gradient steps
    :param target_update_interval: The target critics and the averaged actor are updated once every
        ``target_update_interval`` gradient steps
    :param target_policy_noise: Standard deviation of Gaussian noise added to target actions (smoothing noise)
    :param target_noise_clip: Limit for absolute value of target policy smoothing noise.
    :param diagnostics: whether to log diagnostics of the policy; every 100 gradient steps this costs one more CEM call
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation,
        see :class:`~sb3_cgp.CGPPolicy`; a ``selector`` among them replaces CEM
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of its range or contradicts another one
    :raises TypeError: if an argument is unknown, naming it and the nearest one
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }

    @checks_arguments
    def __init__(
        self,
        policy: str | type[CGPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule | str = 1e-3,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 10_000,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        cem_iterations: int = 2,
        cem_samples: int = 64,
        cem_elites: int = 6,
        cem_result: str = "best",
        cem_start: str = "prior",
        cem_actor_fraction: float = 0.5,
        cem_actor_std: float = 0.3,
        cem_dtype: str = "auto",
        cuda_graphs: bool = True,
        policy_loss: str | None = "cgp",
        policy_training: str = "online",
        inference: str | None = None,
        actor_learning_rate: float | Schedule | str | None = None,
        policy_delay: int = 1,
        target_update_interval: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        diagnostics: bool = True,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        # The mixins' arguments, which `_setup_model` reads
        self.cem_start = cem_start
        self.cem_actor_fraction = cem_actor_fraction
        self.cem_actor_std = cem_actor_std
        self.cem_dtype = cem_dtype
        self.cuda_graphs = cuda_graphs
        self.diagnostics = diagnostics
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            cem_iterations=cem_iterations,
            cem_samples=cem_samples,
            cem_elites=cem_elites,
            cem_result=cem_result,
            policy_loss=policy_loss,
            policy_training=policy_training,
            inference=inference,
            actor_learning_rate=actor_learning_rate,
            policy_delay=policy_delay,
            target_update_interval=target_update_interval,
            target_policy_noise=target_policy_noise,
            target_noise_clip=target_noise_clip,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    @suggests_names
    def learn(
        self: SelfCGP,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CGP",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCGP:
        """
        Train the model, or continue the training that :meth:`resume` has loaded.

        With ``policy_training="offline"``, the policy is trained at the end, see :meth:`train_policy`.

        :param total_timesteps: The total number of samples (env steps) to train on, an integer >= 0, or an equal float
            such as 1e5
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: number of episodes between two writings of the log; None for no writing. The offline training of
            the policy writes after each of its rounds in any case.
        :param tb_log_name: the name of the run for TensorBoard logging
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        :raises ValueError: naming an argument that is wrong, or the fault of an environment
        :raises TypeError: if an argument is unknown, naming it and the nearest one
        :raises RuntimeError: if a worker process of a ``SubprocVecEnv`` has died
        :raises FolderInUseError: if a folder for training states is used by another training
        """
        if self.policy_loss is not None and self.policy_training == "offline":
            check_actor_learns(self.actor)
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    @suggests_names
    def train_policy(
        self: SelfCGP,
        max_steps: int = 100_000,
        batch_size: int | None = None,
        callback: MaybeCallback = None,
        progress_bar: bool = False,
    ) -> SelfCGP:
        """
        Train the policy to convergence on the critics and the replay buffer as they are (the paper's offline training).

        It has converged when, for 5 rounds of 1,000 gradient steps in a row, no round's mean loss was more than 5 % below
        the lowest one before. ``learn`` calls it in offline training; call it yourself on a loaded model with a loaded
        replay buffer (and, if it was trained with ``VecNormalize``, its environment set).

        Callbacks see each gradient step as a step in which no environment moves: ``num_timesteps`` does not change, no
        episode ends, rewards are 0. Values are logged at ``num_timesteps`` plus the number of gradient steps. A callback
        that stops the training before its plateau causes a warning, and the next ``learn`` goes on with it if
        ``policy_training`` is "offline". One that stops it within its first round leaves CEM to act.

        :param max_steps: largest number of gradient steps
        :param batch_size: observations per gradient step, by default the model's
        :param callback: callback(s) called at every gradient step; the training stops when one returns False
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the model, whose ``predict`` then uses the network that ``inference`` names
        :raises ValueError: if there is no policy loss or no data, if gradients are off or the actor is frozen, if observations
            are not normalised and the critics have learnt from normalised ones, or if a loss is NaN or infinite
        """
        if self.resumption is not None:
            raise ValueError(
                "A training state has been loaded by `resume`: call `learn`, which continues it, before `train_policy`."
            )
        check_callback(callback)
        check_gradients(self)
        check_actor_learns(self.actor)
        with self.as_training(), explaining_errors(self):
            self._check_normalisation()
            fit_replay_buffer(self)
            return super().train_policy(max_steps, batch_size, callback, progress_bar)

    @classmethod
    def load(
        cls: type[SelfCGP],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfCGP:
        """
        Load the model from a zip-file, as SB3 does.

        Its replay buffer is None until ``learn`` or ``save_replay_buffer`` allocates it, or ``load_replay_buffer`` loads one.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on
            (can be None if you only need prediction from a trained model) has priority over any saved environment
        :param device: Device on which the code should run.
        :param custom_objects: Dictionary of objects to replace upon loading. A ``learning_rate`` among them replaces an
            actor's own learning rate too: rl_zoo3 replaces schedules that another version of Python may have pickled.
        :param print_system_info: Whether to print system info from the saved model and the current system info
        :param force_reset: Force call to ``reset()`` before training to avoid unexpected behaviour.
        :param kwargs: arguments to change in the model when loading, such as ``cem_iterations=4``
        :return: new model instance with loaded parameters
        :raises ValueError: if a changed argument is out of its range or contradicts another one, or if the file holds a
            population
        :raises TypeError: if a changed argument is none of the constructor and no attribute of the model, naming it and the
            nearest one that is allowed
        :raises IsADirectoryError: if the path is a folder, and there is no zip-file of that name beside it
        """
        if custom_objects is not None and "learning_rate" in custom_objects:
            custom_objects = {"actor_learning_rate": None} | custom_objects
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    @classmethod
    def _check_saved(cls, saved: Mapping[str, Any]) -> None:
        allowed = f"of {cls.__name__}, a single agent: load a population by `sb3_cgp.population.Population.load(path)`"
        # A user's own subclass may have an attribute `agents`
        require("_agent_updates" not in saved, "path", "the file of a population", allowed)

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Load parameters from a zip-file or a nested dictionary, as SB3 does.

        In a model that has not learnt yet, ``predict`` uses the actor from then on if its optimizer's state shows that it has
        been trained. An optimizer without state, such as SGD without momentum, cannot show it: use :meth:`load`.

        :param load_path_or_dict: path to the file (or a file-like), or the parameters by module, see ``get_parameters``
        :param exact_match: whether the parameters of every module must be given
        :param device: Device on which the code should run.
        :raises ValueError: if a module is missing or unknown
        """
        super().set_parameters(load_path_or_dict, exact_match, device)
        if self._n_updates > 0:
            return
        if self.actor.optimizer.state:
            self._mark_policy(is_trained=True)
        elif self.critic.optimizer.state and self.policy.inference != "cem":
            warnings.warn(
                "The critics whose parameters have been set are trained, and the actor is not: `predict` uses it nevertheless."
                " After `load(path, policy_loss='cgp')`, CEM acts until the actor is trained.",
                stacklevel=2,
            )

    def export(self, folder: str | pathlib.Path) -> None:
        """
        Write the policy that ``predict`` uses, to be used elsewhere and loaded without pickle.

        ``policy.onnx`` takes a batch of observations as the environment returns them (images channels first) and returns
        actions as the environment takes them; VecNormalize's present statistics are part of it. It has one input called
        ``observation``, or, for ``Dict`` observations, one for each key, called by the key; its output is ``action``.
        Each input has the data type of its space: float64 observations are given in float64.
        ``policy.safetensors`` and ``policy.json`` are what :meth:`load_weights` reads. Both are evaluated on a few random
        observations, and compared with ``predict``, before any file is written.

        :param folder: where to write; it is made if it is missing. An export in it is replaced when all files of the
            new one are on the disk.
        :raises ValueError: if the policy cannot be exported, naming the obstacle and what is allowed: an actor must
            act, on a ``Box`` or a ``Dict`` of them, by SB3's own features extractors and one of PyTorch's usual activation
            functions
        :raises FileExistsError: if the folder is a file
        :raises ImportError: if a package of the ``export`` extra is not installed
        """
        export_policy(self, folder)

    @classmethod
    def load_weights(cls, folder: str | pathlib.Path) -> ExportedPolicy:
        """
        Load a policy that :meth:`export` wrote, from safetensors and JSON alone. Unlike :meth:`load`, it cannot run code
        that someone put into the files.

        :param folder: where the policy was exported to
        :return: a policy that predicts, and cannot be trained; it takes observations that are not normalised
        :raises ValueError: if a file is damaged or of another export, or an entry is not allowed; it names the file and why
        :raises FileNotFoundError: if ``policy.json`` or ``policy.safetensors`` is missing
        :raises NotADirectoryError: if the folder is a file
        :raises ImportError: if safetensors is not installed
        """
        return load_weights(folder)
