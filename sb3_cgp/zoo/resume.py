"""
The command that continues an interrupted run of ``rl_zoo3.train --algo cgp`` in the run's folder.

``python -m sb3_cgp.zoo.resume logs/cgp/Pendulum-v1_1`` takes no other arguments, as the folder holds the run's settings.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sb3_cgp.common.extras import import_from_extra
from sb3_cgp.zoo.run_folders import hold_run, release_run

# The processes of a SubprocVecEnv import this module as Python's main module, and need rl_zoo3's patch of Gymnasium's
# TimeLimit as they do in `rl_zoo3.train`. `resume` reports that rl_zoo3 is missing.
with suppress(ImportError):
    import rl_zoo3  # noqa: F401


def resume(folder: Path) -> None:
    """
    Train a run to its end, and save its final model as rl_zoo3 does. Do nothing if the run has ended.

    :param folder: the run's folder
    :raises SystemExit: if the run cannot be resumed; it says why
    """
    try:
        import_from_extra("rl_zoo3", "zoo", "Resuming a run of rl_zoo3")
        from sb3_cgp.zoo.resumed_run import is_finished, read_run, set_up

        args, hyperparams = read_run(folder)
        # Before anything is read or written that the run's first process may change
        hold_run(folder)
        if is_finished(folder, args, hyperparams):
            release_run(folder)
            print(f"{folder} has ended: there is nothing to resume")
            return
        experiment, model = set_up(folder, args, hyperparams)
    # RuntimeError and OSError: another process has locked the run or its states
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        release_run(folder)
        sys.exit(f"Error: {error}")
    experiment.learn(model)
    experiment.save_trained_model(model)
    if is_finished(folder, args, hyperparams):
        print(f"{folder} has ended at step {model.num_timesteps:,}: its final model is {folder / experiment.env_name}.zip")


def main(argv: Sequence[str] | None = None) -> None:
    """
    Resume the run that the command line names.

    :param argv: the command line; None for that of the process
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_cgp.zoo.resume", description="Resume a run of rl_zoo3 with CGP.")
    parser.add_argument("folder", help="the run's folder, such as logs/cgp/Pendulum-v1_1")
    resume(Path(os.path.normpath(parser.parse_args(argv).folder)))


if __name__ == "__main__":
    main()
