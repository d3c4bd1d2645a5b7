"""The progress bar of a resumed training, which counts the steps before the resumption, too."""

from stable_baselines3.common.callbacks import ProgressBarCallback, tqdm

from sb3_cgp.resumption.model import ResumableModel


def show_whole_training(callback: ProgressBarCallback, model: ResumableModel) -> None:
    """
    Let a progress bar begin where the resumed training does, and end where the whole training does.

    SB3's own ends at the number of steps that are left.

    :param callback: SB3's callback
    :param model: the model that resumes its training
    """

    def start() -> None:
        start = model._training_started_at
        callback.pbar = tqdm(total=callback.locals["total_timesteps"] - start, initial=model.num_timesteps - start)

    # On the object, as a subclass would be another callback to those who look for the class, such as a training's state
    callback._on_training_start = start  # type: ignore[method-assign]
