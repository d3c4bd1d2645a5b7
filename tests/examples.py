"""Run the Python examples of a page, shortened."""

import re
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.callbacks import EvalCallback

from sb3_cgp import CGP

ROOT = Path(__file__).parent.parent
# Past the warm-up of the shortened examples
STEPS = 60
WARM_UP = 50


def python_examples(page: str) -> list[str]:
    """Return the Python blocks of a Markdown file, given relative to the repository's root."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)


def shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    Shorten trainings to a few steps, of which some are gradient steps, and offline training to a few rounds.

    What is shortened are the numbers alone: arguments are checked as they are.
    """
    learn, construct, construct_evaluation = CGP.learn, CGP.__init__, EvalCallback.__init__

    def construct_short(self: CGP, *args: object, **kwargs: object) -> None:
        construct(self, *args, **kwargs)
        self.learning_starts = min(self.learning_starts, WARM_UP)

    def learn_short(self: CGP, total_timesteps: int, *args: object, **kwargs: object) -> CGP:
        return learn(self, min(total_timesteps, STEPS), *args, **kwargs)

    def construct_frequent(self: EvalCallback, *args: Any, **kwargs: Any) -> None:
        construct_evaluation(self, *args, **kwargs)
        self.eval_freq = min(self.eval_freq, STEPS // 2)

    monkeypatch.setattr(CGP, "__init__", construct_short)
    monkeypatch.setattr(EvalCallback, "__init__", construct_frequent)
    monkeypatch.setattr(CGP, "learn", learn_short)
    monkeypatch.setattr("sb3_cgp.core.offline.ROUND", 2)


def run_in_order(page: str, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Run all Python blocks of a page one after another in a folder, each as a script of its own, with shortened trainings."""
    shortened(monkeypatch)
    monkeypatch.chdir(folder)
    for example in python_examples(page):
        exec(compile(example, page, "exec"), {"__name__": "__main__"})
