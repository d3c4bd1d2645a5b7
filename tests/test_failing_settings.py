"""Settings with which CGP is said to fail, where several studies varied them."""

from pathlib import Path

from finished_studies import record, runs, study

from benchmark.reporting.failures import few_steps_fail
from benchmark.reporting.scores import score_table


def test_each_study_is_compared_within_itself(tmp_path: Path) -> None:
    """What is few in one of them is the most that was tried in the other, whose runs differ in more than the setting."""
    levels = {"short": {0: 10.0, 1_000: 90.0}, "long": {1_000: 40.0, 10_000: 100.0}}
    studies = []
    for name, level in levels.items():
        configurations = [{"learning_starts": steps} for steps in level]
        own = runs(lambda _, settings, __, level=level: level[settings["learning_starts"]], ["CGP-Online"], configurations)
        # From 0 to 100, so that shares are percents
        scale = record("Random", 0, 0.0, settings=configurations[0])
        studies.append(study(tmp_path, [*own, scale], name))
    (found,) = few_steps_fail(score_table(studies), repetitions=50)
    assert found.text.startswith("mean 0.250 with 0 or 1000, 0.950 with 1000 or 10000: 0.700 ")
    assert found.text.endswith("; 8 of 8 runs below half of the latter")
