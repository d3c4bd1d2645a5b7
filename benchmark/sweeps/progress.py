"""The progress of a sweep: counts of runs, speed and time left."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from optuna.trial import FrozenTrial, TrialState
from rich.progress import BarColumn, Progress, TextColumn

from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.study_trials import CONTINUED, ERROR, KEY, owned

# Seconds over which the speed is measured, over which it is measured for the time left, and between two lines without a
# terminal. The second is long as a step's cost differs from run to run, and offline policy training takes no step.
WINDOW, LONG_WINDOW, LINE_INTERVAL = 120.0, 3600.0, 60.0


@dataclass(frozen=True)
class SweepProgress:
    """
    The progress of a sweep.

    :param runs: number of runs
    :param done: number of completed runs
    :param running: number of runs that processes train
    :param failed: number of runs that failed for their own reasons
    :param share: share of all environment steps that has been taken
    :param speed: environment steps per second, of all processes together; None before it is known
    :param seconds_left: the estimated time left; None before it is known
    """

    runs: int
    done: int
    running: int
    failed: int
    share: float
    speed: float | None
    seconds_left: float | None

    def __str__(self) -> str:
        speed = "-" if self.speed is None else f"{self.speed:,.0f}"
        left = "-" if self.seconds_left is None else _clock(self.seconds_left)
        counts = f"{self.done} of {self.runs} runs done, {self.running} running, {self.failed} failed"
        return f"{counts}, {speed} steps/s, {left} left"


def _clock(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    return f"{hours}:{rest // 60:02}:{rest % 60:02}"


class RateEstimator:
    """
    Measures the growth rate of a count.

    :param window: length of the sliding window in seconds
    """

    def __init__(self, window: float):
        self._window = window
        self._history: deque[tuple[float, int]] = deque()

    def add(self, now: float, count: int) -> float | None:
        """
        Add a measurement.

        :param now: the time in seconds
        :param count: the count
        :return: the growth per second within the window; None if the count has not grown
        """
        self._history.append((now, count))
        while now - self._history[0][0] > self._window:
            self._history.popleft()
        then, count_then = self._history[0]
        return (count - count_then) / (now - then) if now > then and count > count_then else None


class ProgressTracker:
    """
    Counts the runs and steps of a study.

    :param steps: environment steps of each run
    """

    def __init__(self, steps: int):
        self._steps = steps
        self._rate, self._long_rate = RateEstimator(WINDOW), RateEstimator(LONG_WINDOW)
        # By trial, the step from which its steps count for the speed
        self._starts: dict[int, int] = {}

    def add(self, trials: Sequence[FrozenTrial], now: float | None = None) -> SweepProgress:
        """
        Add a read of the study's trials.

        :param trials: the trials
        :param now: the time in seconds; by default that of a clock
        :return: the progress
        """
        now = time.monotonic() if now is None else now
        runs = list(owned(trials).values())
        running = [trial for trial in runs if trial.state is TrialState.RUNNING]
        ended = [trial for trial in runs if trial.state.is_finished()]
        taken = self._steps * len(ended) + sum(map(_step, running))
        total = self._steps * len(runs)
        trained = self._trained(trials)
        long_speed = self._long_rate.add(now, trained)
        failed = sum(ERROR in trial.user_attrs for trial in ended)
        return SweepProgress(
            runs=len(runs),
            done=len(ended) - failed,
            running=len(running),
            failed=failed,
            share=taken / max(total, 1),
            speed=self._rate.add(now, trained),
            seconds_left=None if long_speed is None else (total - taken) / long_speed,
        )

    def _trained(self, trials: Sequence[FrozenTrial]) -> int:
        """Return the steps that were taken since the first call, without those of the states from which trials went on."""
        begun: set[str] = set()
        trained = 0
        for trial in sorted(trials, key=lambda trial: trial.number):
            key, step = trial.user_attrs[KEY], _step(trial)
            goes_on = key in begun or CONTINUED in trial.user_attrs
            # A trial that goes on reports no step until it has loaded the state
            if trial.number not in self._starts or (goes_on and self._starts[trial.number] == 0):
                self._starts[trial.number] = step
            trained += step - self._starts[trial.number]
            if step > 0:
                begun.add(key)
        return trained


def _step(trial: FrozenTrial) -> int:
    """Return the environment steps that a trial's last heartbeat reported."""
    return int(trial.user_attrs.get(PROGRESS, {}).get("step", 0))


@contextmanager
def display(title: str) -> Iterator[Callable[[SweepProgress], None]]:
    """
    Show the progress of a sweep: a bar in a terminal, a line every minute elsewhere.

    :param title: the sweep's name
    :return: a function that shows the progress
    """
    if not sys.stderr.isatty():
        yield _print_at_intervals(title)
        return
    with Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[counts]}")) as bar:
        task = bar.add_task(title, total=1.0, counts="")
        yield lambda progress: bar.update(task, completed=progress.share, counts=str(progress))


def _print_at_intervals(title: str) -> Callable[[SweepProgress], None]:
    last: list[float] = []

    def show(progress: SweepProgress) -> None:
        now = time.monotonic()
        has_ended = progress.done + progress.failed == progress.runs
        if not last or now - last[-1] >= LINE_INTERVAL or has_ended:
            last[:] = [now]
            print(f"{title}: {progress}", file=sys.stderr, flush=True)

    return show
