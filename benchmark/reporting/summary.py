"""The figure of a README: learning curves on one task, beside the stability of one sweep over hyperparameters."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from benchmark.common.canvas import BAND, draw_line, draw_seeds, legend, panels, png, styled
from benchmark.common.style import styles
from benchmark.reporting.drawing import RUNS_THAT_REACH_IT, draw_stability
from benchmark.reporting.estimates import bootstrap, interquartile_mean
from benchmark.reporting.learning_curves import show_learnt_range
from benchmark.reporting.scores import Study, curves, evaluation_grid, floors, score_table
from benchmark.reporting.verdicts import SHOWN_FIRST


@styled
def summary(learning: Study, sweep: Study, repetitions: int) -> bytes:
    """
    Draw the learning curves of a study's first task, and the stability curves of a sweep's.

    :param learning: a study without axes
    :param sweep: a study with axes
    :param repetitions: number of bootstrap samples
    :return: the picture, as PNG
    :raises ValueError: if a study is not of its kind, or has no evaluation of the methods
    """
    if learning.axes or not sweep.axes:
        raise ValueError(f"{learning.name} must be a study of learning curves, and {sweep.name} one of hyperparameters")
    figure, (left, right) = panels(2, share=False, columns=2, size=(3.7, 2.5))
    _draw_learning(left, learning, repetitions)
    _draw_stability(right, sweep, repetitions)
    legend(figure, [left, right])
    return png(figure)


def methods_of(study: Study, task: str) -> Sequence[str]:
    """
    Return the methods that are drawn.

    :param study: the study
    :param task: its task
    :return: the methods
    :raises ValueError: if no run of any has been evaluated
    """
    runs = [record for record in study.records if record.task == task and record.method in SHOWN_FIRST]
    methods = [method for method in SHOWN_FIRST if any(run.method == method for run in runs)]
    if not any(run.returns for run in runs):
        raise ValueError(f"{study.name} has no evaluation of {', '.join(SHOWN_FIRST)}")
    return methods


def _draw_learning(panel: Axes, study: Study, repetitions: int) -> None:
    task = next(iter(study.tasks), "")
    floor, grid = floors(study.records).get(task, 0.0), evaluation_grid(study.records, task)
    drawn = []
    for method, look in styles(methods_of(study, task)).items():
        runs = [record for record in study.records if (record.task, record.method) == (task, method)]
        lines = curves(runs, floor, grid)
        middle, interval = bootstrap(interquartile_mean, [{"": lines}], repetitions)
        draw_seeds(panel, grid, lines, look["color"])
        draw_line(panel, grid, middle, study.label(method, len(runs)), look)
        if interval is not None:
            panel.fill_between(grid, *interval, color=look["color"], **BAND)
        drawn.append(lines)
    panel.set(title=task, xlabel="environment steps", ylabel="return", xlim=(0, grid[-1]))
    show_learnt_range(panel, study, grid, drawn)
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.yaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_stability(panel: Axes, study: Study, repetitions: int) -> None:
    task = next(iter(study.tasks), "")
    methods = methods_of(study, task)
    table = score_table([study])
    draw_stability(panel, table[(table["task"] == task) & table["method"].isin(methods)], methods, repetitions)
    panel.set(title=f"{task}, {_configurations(study)}", ylabel=RUNS_THAT_REACH_IT)


def _configurations(study: Study) -> str:
    number = len({tuple(sorted(record.settings.items())) for record in study.records})
    return f"{number} settings"
