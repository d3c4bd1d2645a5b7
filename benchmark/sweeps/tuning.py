"""
Tuning as an Optuna study: each trial is a configuration, scored by several seeds, and pruned between them.

rl_zoo3's samplers suggest, and what their suggestions make of the task's YAML entry is trained, as it stands in the end in
the file. A trial whose process is lost, or stopped, is enqueued again with the scores of the seeds that were finished; its
unfinished one is taken up from its last state.
"""

import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
from filelock import FileLock
from gymnasium import spaces
from optuna.exceptions import UpdateFinishedTrialError
from optuna.pruners import BasePruner, NopPruner, WilcoxonPruner
from optuna.samplers import TPESampler
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from scipy.stats import trim_mean

from benchmark.sweeps.entries import sampled_entry
from benchmark.sweeps.experiments import Run
from benchmark.sweeps.heartbeats import Heart, Silence, TrialLostError, send_beat
from benchmark.sweeps.run import MACHINE_ERRORS, forget_states, run_folder, train
from benchmark.sweeps.storages import patiently
from benchmark.sweeps.studies import ERROR, OUTCOME
from benchmark.sweeps.sweep_files import Hyperparams, SweepError

# Attributes: of the study, and of a trial: the seeds' scores so far, and the number of its first attempt
TUNING, SCORES, ORIGIN = "tuning", "scores", "origin"
# Why a trial ended that did not end its configuration
STOPPED = "given back: its process was stopped"
# Trials that are not pruned, for others to be compared with
N_STARTUP_TRIALS = 5

SCORING: dict[str, Callable[[Sequence[float]], float]] = {
    "mean": lambda scores: float(np.mean(scores)),
    # Without the lowest and the highest quarter
    "iqm": lambda scores: float(trim_mean(scores, 0.25)),
    "min": min,
}


class ScorePruner(BasePruner):
    """Gives up what scores less than complete trials' median after as many seeds. Optuna's compares its best score so far."""

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """
        Compare a trial's last score.

        :param study: the study
        :param trial: the trial
        :return: whether it is to be given up
        """
        step = trial.last_step
        complete = patiently(study.get_trials, deepcopy=False, states=(TrialState.COMPLETE,))
        others = [each.intermediate_values[step] for each in complete if step in each.intermediate_values]
        if step is None or len(others) < N_STARTUP_TRIALS:
            return False
        return trial.intermediate_values[step] < float(np.median(others))


PRUNERS: dict[str, Callable[[], BasePruner]] = {
    "median": ScorePruner,
    "wilcoxon": lambda: WilcoxonPruner(p_threshold=0.1),
    "none": NopPruner,
}


@dataclass(frozen=True)
class Tuning:
    """
    What is tuned, and how.

    :param algo: the algorithm's name in rl_zoo3
    :param task: the environment
    :param base: the task's entry before any hyperparameter is sampled
    :param fixed: hyperparameters that take the place of sampled ones
    :param steps: environment steps of each run
    :param seeds: runs of each configuration, with seeds from 0
    :param score: what is made of the seeds' final returns, one of ``SCORING``
    :param pruner: when a configuration is given up, one of ``PRUNERS``
    :param evaluation_interval: environment steps between two evaluations
    :param evaluation_episodes: episodes of each evaluation
    :param checkpoint_interval: environment steps between two states to go on from
    """

    algo: str
    task: str
    base: Hyperparams
    fixed: Hyperparams
    steps: int
    seeds: int
    score: str
    pruner: str
    evaluation_interval: int
    evaluation_episodes: int
    checkpoint_interval: int

    def sample(self, trial: optuna.Trial) -> None:
        """
        Suggest hyperparameters.

        :param trial: the trial, which keeps them
        """
        env = gym.make(self.task)
        n_actions = env.action_space.shape[0] if isinstance(env.action_space, spaces.Box) else 0
        env.close()
        uses_her = "HerReplayBuffer" in str(self.base.get("replay_buffer_class"))
        HYPERPARAMS_SAMPLER[self.algo](
            trial, n_actions, self.base.get("n_envs", 1), {"using_her_replay_buffer": uses_her, "her_kwargs": {}}
        )

    def entry(self, trial: FrozenTrial) -> Hyperparams:
        """
        Make a trial's hyperparameters.

        :param trial: the trial
        :return: an entry of rl_zoo3's YAML files
        """
        return {**sampled_entry(self.algo, self.base, trial.params), **self.fixed, "n_timesteps": self.steps}

    def run(self, trial: FrozenTrial, seed: int) -> Run:
        """
        Make one of a trial's runs.

        :param trial: the trial
        :param seed: the seed
        :return: the run, in a folder that later attempts at the same configuration share
        """
        return Run(
            f"trial-{trial.user_attrs.get(ORIGIN, trial.number)}",
            self.task,
            {},
            seed,
            self.algo,
            self.entry(trial),
            False,
            self.steps,
            self.evaluation_interval,
            self.evaluation_episodes,
            self.checkpoint_interval,
        )


class Tuner:
    """
    A process's view of a study that tunes.

    :param storage: where the study is
    :param name: the study's name
    :param tuning: what is tuned
    :param grace: seconds of silence after which a process is taken for lost
    """

    def __init__(self, storage: BaseStorage, name: str, tuning: Tuning, grace: float):
        self._storage, self._tuning = storage, tuning
        self._silence = Silence(grace)
        self._study = patiently(
            optuna.create_study,
            storage=storage,
            study_name=name,
            direction="maximize",
            load_if_exists=True,
            # Without a seed, as processes that go on, or join, are not to suggest what others have suggested
            sampler=TPESampler(multivariate=True, constant_liar=True),
            pruner=PRUNERS[tuning.pruner](),
        )
        self._study_id = patiently(storage.get_study_id_from_name, name)
        self._check()

    def _check(self) -> None:
        now = asdict(self._tuning)
        was = patiently(lambda: self._study.user_attrs).get(TUNING)
        if was is None:
            patiently(self._study.set_user_attr, TUNING, now)
        elif was != now:
            key = next(key for key in now if was.get(key) != now[key])
            problem = f"was {was.get(key)!r} and is now {now[key]!r}. Choose another name by --study"
            raise SweepError(f"The study {self._study.study_name!r}", key, problem)

    def trials(self) -> list[FrozenTrial]:
        """
        Read the study's trials.

        :return: the trials
        """
        return patiently(self._study.get_trials, deepcopy=False)

    def recover(self) -> None:
        """
        Enqueue again what lost processes have left.

        If this process dies between its two steps, a configuration is lost, and another will be sampled in its place.
        """
        for trial in self._silence.find(self.trials()):
            self._give_back(trial.number, "lost: its process fell silent")

    def _give_back(self, number: int, outcome: str) -> None:
        trial_id = self._id(number)
        try:
            patiently(self._storage.set_trial_user_attr, trial_id, OUTCOME, outcome)
            patiently(self._storage.set_trial_state_values, trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            return
        trial = patiently(self._storage.get_trial, trial_id)
        # Of a configuration that was enqueued, some parameters may not have been suggested again yet
        params = {**trial.system_attrs.get("fixed_params", {}), **trial.params}
        if params and ERROR not in trial.user_attrs:
            attributes = {ORIGIN: trial.user_attrs.get(ORIGIN, trial.number), SCORES: trial.user_attrs.get(SCORES, [])}
            patiently(self._study.enqueue_trial, params, attributes)

    def _id(self, number: int) -> int:
        return patiently(self._storage.get_trial_id_from_study_id_trial_number, self._study_id, number)

    def attempt(self, logs: Path, interval: float, parent: int | None, device: str) -> None:
        """
        Take a trial, one that waits or a new one, train its configuration with each seed, and end it.

        :param logs: the folder of all studies' runs
        :param interval: seconds between two heartbeats
        :param parent: the process that started this one
        :param device: where the networks compute
        """
        trial = patiently(self._study.ask)
        trial_id = self._id(trial.number)

        def beat(count: str, step: int, seconds: float) -> None:
            send_beat(self._storage, trial_id, count, step, seconds)

        try:
            with Heart(beat, interval, parent) as heart:
                patiently(self._tuning.sample, trial)
                scores = self._scores(trial, trial_id, logs, heart, device)
            value = None if scores is None else SCORING[self._tuning.score](scores)
            state = TrialState.PRUNED if value is None else TrialState.COMPLETE
            patiently(self._study.tell, trial, value, state, skip_if_finished=True)
        except (TrialLostError, UpdateFinishedTrialError):
            print(f"Trial {trial.number} was given up by another process", flush=True)
        except MACHINE_ERRORS:
            self._give_back(trial.number, STOPPED)
            raise
        except Exception as error:
            traceback.print_exc()
            self._fail(trial_id, error)
        except BaseException:
            self._give_back(trial.number, STOPPED)
            raise

    def _scores(self, trial: optuna.Trial, trial_id: int, logs: Path, heart: Heart, device: str) -> list[float] | None:
        """Train a configuration with one seed after another; None if it is pruned."""
        frozen = patiently(self._storage.get_trial, trial_id)
        scores = list(frozen.user_attrs.get(SCORES, []))
        for seed in range(self._tuning.seeds):
            if seed == len(scores):
                run = self._tuning.run(frozen, seed)
                folder = run_folder(logs, self._study.study_name, run)
                folder.mkdir(parents=True, exist_ok=True)
                print(f"{time.strftime('%H:%M:%S')} {run.key}", flush=True)
                # Another process that was given up, but is not dead, may still be writing there
                with FileLock(folder / ".lock"):
                    scores.append(train(run, folder, lambda step, value: None, heart.watch, device))
                patiently(trial.set_user_attr, SCORES, scores)
                forget_states(folder)
            # The test by Wilcoxon pairs the seeds; the others compare what the score is so far
            is_paired = self._tuning.pruner == "wilcoxon"
            value = scores[seed] if is_paired else SCORING[self._tuning.score](scores[: seed + 1])
            patiently(trial.report, value, seed)
            if seed + 1 < self._tuning.seeds and patiently(trial.should_prune):
                return None
        return scores

    def _fail(self, trial_id: int, error: Exception) -> None:
        try:
            patiently(self._storage.set_trial_user_attr, trial_id, ERROR, f"{type(error).__name__}: {error}")
            patiently(self._storage.set_trial_state_values, trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            pass


def is_over(trial: FrozenTrial) -> bool:
    """
    Tell whether a trial counts.

    :param trial: the trial
    :return: whether its configuration was scored, pruned, or failed for its own reasons
    """
    return trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or ERROR in trial.user_attrs


def best_of(trials: Iterable[FrozenTrial]) -> FrozenTrial | None:
    """
    Find the best configuration.

    :param trials: a study's trials
    :return: the trial with the highest score; None if no configuration has one
    """
    completed = [trial for trial in trials if trial.state is TrialState.COMPLETE]
    return max(completed, key=lambda trial: trial.values[0], default=None)
