"""Registration of CGP in rl_zoo3: the algorithm, its default hyperparameters, its checkpoints and its search space.

An installed sb3_cgp is registered as soon as rl_zoo3 is imported (``_sb3_cgp_zoo.py``). Where that hook does not run, as in a
source tree or under ``python -S``, call :func:`register`. The functions import rl_zoo3 themselves, because the hook calls
them while rl_zoo3 is still being imported.
"""

import functools
import importlib
import inspect
from typing import Any

from sb3_cgp import CGP
from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.hparams import HParamsCallback
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback
from sb3_cgp.zoo.checkpoints import prepare_checkpoints, without_checkpoints
from sb3_cgp.zoo.folders import ALGO, hyperparams_folder, state_folder
from sb3_cgp.zoo.model_card import complete_model_cards
from sb3_cgp.zoo.run_folders import hold_run, how_to_continue, release_run
from sb3_cgp.zoo.search_space import convert_cgp_params, sample_cgp_params


def register() -> None:
    """
    Register CGP in rl_zoo3: ``--algo cgp``, its default hyperparameters and its search space. A repetition has no effect.

    :raises ImportError: if rl_zoo3, or a package that it imports, is not installed
    """
    import_from_extra("rl_zoo3", "zoo", "Registering CGP in rl_zoo3")
    register_algorithm()
    register_search_space()
    register_default_config()


def register_algorithm() -> None:
    """Add CGP to rl_zoo3's algorithms, which are the choices for ``--algo`` of its scripts."""
    from rl_zoo3.utils import ALGOS

    ALGOS[ALGO] = CGP
    restore_generate_metadata()
    complete_model_cards()


def restore_generate_metadata() -> None:
    """
    Restore ``generate_metadata`` of ``huggingface_sb3``, which ``rl_zoo3.push_to_hub`` imports, if it is missing.

    sb3-team-hf-integration 3.2, the only release that rl_zoo3 2.9.2 accepts, has made the function private, and returns an
    object where rl_zoo3 needs a dictionary.
    """
    # huggingface_sb3 hides this module behind a function of the same name.
    hub: Any = importlib.import_module("huggingface_sb3.push_to_hub")
    if hasattr(hub, "generate_metadata") or not hasattr(hub, "_generate_metadata"):
        return

    def generate_metadata(model_name: str, env_id: str, mean_reward: float, std_reward: float) -> dict[str, Any]:
        return hub._generate_metadata(model_name, env_id, mean_reward, std_reward).to_dict()

    hub.generate_metadata = generate_metadata


def register_search_space() -> None:
    """Add the search space, for ``rl_zoo3.train -optimize`` and ``--trial-id``."""
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    HYPERPARAMS_SAMPLER[ALGO] = sample_cgp_params
    HYPERPARAMS_CONVERTER[ALGO] = convert_cgp_params


def register_default_config() -> None:
    """
    Make our ``cgp.yml`` the default of ``--conf-file``, save training states to ``state`` in the run's folder, fill
    TensorBoard's tab HParams, and evaluate with the ``env_kwargs`` of the hyperparameters.

    rl_zoo3 looks for default hyperparameters inside its own package only.
    """
    from rl_zoo3.exp_manager import ExperimentManager

    initialise = ExperimentManager.__init__
    if hasattr(initialise, "reads_cgp_yml"):
        return
    signature = inspect.signature(initialise)

    @functools.wraps(initialise)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        initialise(self, *args, **kwargs)
        given = signature.bind(self, *args, **kwargs).arguments
        if self.algo == ALGO and not given.get("config"):
            self.config = str(hyperparams_folder() / f"{ALGO}.yml")

    __init__.reads_cgp_yml = True  # type: ignore[attr-defined]
    ExperimentManager.__init__ = __init__  # type: ignore[method-assign]

    create_callbacks = ExperimentManager.create_callbacks

    @functools.wraps(create_callbacks)
    def create_callbacks_with_folder(self: Any) -> None:
        if self.optimize_hyperparameters:
            # Of which each trial makes callbacks of its own
            self.specified_callbacks = without_checkpoints(self.specified_callbacks)
        else:
            prepare_checkpoints(self)
        create_callbacks(self)
        has_own = any(isinstance(each, HParamsCallback) for each in self.callbacks)
        if self.algo == ALGO and self.tensorboard_log and not has_own:
            self.callbacks.append(HParamsCallback())
        # After an error, rl_zoo3 ends the first callback, which it takes for the progress bar
        self.callbacks.sort(key=lambda callback: isinstance(callback, TrainingCheckpointCallback))

    ExperimentManager.create_callbacks = create_callbacks_with_folder  # type: ignore[method-assign]
    evaluate_with_env_kwargs()
    hold_folders()


def evaluate_with_env_kwargs() -> None:
    """Let the evaluations of a run, by any algorithm, take the ``env_kwargs`` of its hyperparameters."""
    from rl_zoo3.exp_manager import ExperimentManager

    # Private, but the one method that reads the hyperparameters' `env_kwargs`
    preprocess = ExperimentManager._preprocess_hyperparams

    @functools.wraps(preprocess)
    def preprocess_for_both(self: Any, hyperparams: dict[str, Any]) -> Any:
        # As the constructor, which knows those of the command line alone, makes them without `eval_env_kwargs`
        are_one = self.eval_env_kwargs is self.env_kwargs
        preprocessed = preprocess(self, hyperparams)
        if are_one:
            self.eval_env_kwargs = self.env_kwargs
        return preprocessed

    ExperimentManager._preprocess_hyperparams = preprocess_for_both  # type: ignore[method-assign]


def hold_folders() -> None:
    """Let a run of CGP hold its folder until its model is saved, and tell how it is continued if it was interrupted."""
    from rl_zoo3.exp_manager import ExperimentManager

    learn, save_trained_model = ExperimentManager.learn, ExperimentManager.save_trained_model

    @functools.wraps(learn)
    def learn_and_release(self: Any, model: Any) -> None:
        if self.algo == ALGO:
            hold_run(self.save_path)
        try:
            learn(self, model)
        except BaseException:
            # After an error, or SIGTERM, no model is saved
            _end(self, model)
            raise

    @functools.wraps(save_trained_model)
    def save_and_release(self: Any, model: Any) -> None:
        try:
            save_trained_model(self, model)
        finally:
            _end(self, model)

    def _end(experiment: Any, model: Any) -> None:
        if experiment.algo == ALGO:
            release_run(experiment.save_path)
            paths = [each.path for each in experiment.callbacks if isinstance(each, TrainingCheckpointCallback)]
            states = next(filter(None, paths), None) or state_folder(experiment.save_path)
            advice = how_to_continue(experiment.save_path, str(states), model, experiment.n_timesteps)
            if advice is not None:
                print(advice, flush=True)

    ExperimentManager.learn = learn_and_release  # type: ignore[method-assign]
    ExperimentManager.save_trained_model = save_and_release  # type: ignore[method-assign]
