"""How far a sweep is, for whoever waits for it."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from optuna.trial import FrozenTrial, TrialState
from rich.progress import BarColumn, Progress, TextColumn

from benchmark.sweeps.heartbeats import PROGRESS
from benchmark.sweeps.studies import ERROR, owned

# Seconds over which the speed is measured; over which it is for the time left, as a step's cost differs from run to run, and
# policies that are trained offline take time without any; and between two lines where there is no terminal
WINDOW, LONG_WINDOW, LINE_INTERVAL = 120.0, 3600.0, 60.0


@dataclass(frozen=True)
class Standing:
    """
    How far a sweep is.

    :param runs: runs in all
    :param done: runs that are completed
    :param running: runs that are being trained
    :param failed: runs that failed for their own reasons
    :param share: share of all environment steps that has been taken
    :param speed: environment steps per second, of all processes together; None while it is not known
    :param seconds_left: an estimate; None while it is not known
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


class Pace:
    """
    Measures the speed of a count that grows.

    :param window: seconds that are looked back upon
    """

    def __init__(self, window: float):
        self._window = window
        self._history: deque[tuple[float, int]] = deque()

    def look(self, now: float, count: int) -> float | None:
        """
        Take the count in.

        :param now: the time in seconds
        :param count: the count
        :return: its growth per second; None if it has not grown
        """
        self._history.append((now, count))
        while now - self._history[0][0] > self._window:
            self._history.popleft()
        then, count_then = self._history[0]
        return (count - count_then) / (now - then) if now > then and count > count_then else None


class Tally:
    """
    Counts a study's runs and steps.

    :param steps: environment steps of each run
    """

    def __init__(self, steps: int):
        self._steps = steps
        self._pace, self._long_pace = Pace(WINDOW), Pace(LONG_WINDOW)

    def look(self, trials: Sequence[FrozenTrial], now: float | None = None) -> Standing:
        """
        Take the study's trials in.

        :param trials: the trials
        :param now: the time in seconds; by default that of a clock
        :return: how far it is
        """
        now = time.monotonic() if now is None else now
        runs = list(owned(trials).values())
        running = [trial for trial in runs if trial.state is TrialState.RUNNING]
        ended = [trial for trial in runs if trial.state.is_finished()]
        taken = self._steps * len(ended) + sum(trial.user_attrs.get(PROGRESS, {}).get("step", 0) for trial in running)
        total = self._steps * len(runs)
        long_speed = self._long_pace.look(now, taken)
        failed = sum(ERROR in trial.user_attrs for trial in ended)
        return Standing(
            runs=len(runs),
            done=len(ended) - failed,
            running=len(running),
            failed=failed,
            share=taken / max(total, 1),
            speed=self._pace.look(now, taken),
            seconds_left=None if long_speed is None else (total - taken) / long_speed,
        )


@contextmanager
def display(title: str) -> Iterator[Callable[[Standing], None]]:
    """
    Show how far a sweep is: a bar in a terminal, a line now and then elsewhere.

    :param title: the sweep's name
    :return: takes the standing
    """
    if not sys.stderr.isatty():
        yield _line_now_and_then(title)
        return
    with Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[standing]}")) as progress:
        task = progress.add_task(title, total=1.0, standing="")
        yield lambda standing: progress.update(task, completed=standing.share, standing=str(standing))


def _line_now_and_then(title: str) -> Callable[[Standing], None]:
    last: list[float] = []

    def show(standing: Standing) -> None:
        now = time.monotonic()
        is_over = standing.done + standing.failed == standing.runs
        if not last or now - last[-1] >= LINE_INTERVAL or is_over:
            last[:] = [now]
            print(f"{title}: {standing}", file=sys.stderr, flush=True)

    return show
