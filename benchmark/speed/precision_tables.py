"""The tables of rewards and of elites by data type, in Markdown."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from benchmark.common.tables import markdown_table
from benchmark.speed.elites import STATES
from benchmark.speed.precision_runs import DTYPES, EPISODES

NOTES = """\
Return: mean and standard deviation over the seeds of each run's mean over {episodes} episodes of its final model. Difference:
bfloat16 less float32, with Welch's 95 % confidence interval; p is Welch's t-test's and the exact Mann-Whitney test's. Elites:
the share of float32's elites that are bfloat16's, too, in CEM's first and second iteration, by the critic and by the target
critic that float32's runs ended with, on {states:,} replayed states each; both choose among the same samples. Shown are
the mean over the seeds and the lowest seed's."""


def compare(float32: Sequence[float], bfloat16: Sequence[float]) -> dict[str, Any]:
    """
    Compare final returns.

    :param float32: each seed's mean return with float32
    :param bfloat16: each seed's mean return with bfloat16
    :return: the difference of the means, its 95 % confidence interval, and the p-values of two tests
    """
    welch = stats.ttest_ind(bfloat16, float32, equal_var=False)
    interval = welch.confidence_interval(0.95)
    return {
        "difference": float(np.mean(bfloat16) - np.mean(float32)),
        "interval": (float(interval.low), float(interval.high)),
        "welch_p": float(welch.pvalue),
        "mann_whitney_p": float(stats.mannwhitneyu(bfloat16, float32, method="exact").pvalue),
    }


def reward_row(runs: list[dict[str, Any]]) -> list[str]:
    """
    Write a line of the table of rewards.

    :param runs: a task's records
    :return: the cells
    """
    means = {dtype: [float(np.mean(run["returns"])) for run in runs if run["dtype"] == dtype] for dtype in DTYPES}
    seeds = (", ".join(str(run["seed"]) for run in runs if run["dtype"] == dtype) for dtype in DTYPES)
    row = [runs[0]["env"], " / ".join(dict.fromkeys(filter(None, seeds))), f"{runs[0]['steps']:,}"]
    if any(len(values) < 2 for values in means.values()):
        return [*row, "-", "-", "-", "-"]
    row += [f"{np.mean(values):.1f} ± {np.std(values, ddof=1):.1f}" for values in means.values()]
    found = compare(means["float32"], means["bfloat16"])
    low, high = found["interval"]
    return [
        *row,
        f"{found['difference']:.1f} ({low:.1f} to {high:.1f})",
        f"{found['welch_p']:.2f}, {found['mann_whitney_p']:.2f}",
    ]


def elite_rows(runs: list[dict[str, Any]]) -> list[list[str]]:
    """
    Write the lines of the table of elites.

    :param runs: a task's records
    :return: the cells of a line for each network
    """
    compared = [run["overlaps"] for run in runs if "overlaps" in run]
    rows = []
    for network in compared[0] if compared else []:
        shares = np.array([overlaps[network] for overlaps in compared])
        rows.append([runs[0]["env"], network, *(f"{np.mean(column):.1%} ({np.min(column):.1%})" for column in shares.T)])
    return rows


def markdown(records: list[dict[str, Any]]) -> str:
    """
    Write the tables of rewards and of elites.

    :param records: the runs
    :return: both, in Markdown
    """
    tasks = [[record for record in records if record["env"] == env_id] for env_id in sorted({r["env"] for r in records})]
    return "\n\n".join(
        [
            "# What bfloat16 costs",
            markdown_table(["task", "seeds", "steps", *DTYPES, "difference", "p"], [reward_row(runs) for runs in tasks]),
            markdown_table(
                ["task", "network", "first iteration", "second iteration"], [row for runs in tasks for row in elite_rows(runs)]
            ),
            NOTES.format(episodes=EPISODES, states=STATES),
            "The records beside this page hold each run's command, versions and hardware.\n",
        ]
    )
