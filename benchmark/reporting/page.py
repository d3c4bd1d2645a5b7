"""The results page of sweeps: its beginning, its claims, and how to read it."""

from collections.abc import Sequence

from benchmark.common.records import FINAL_EPISODES
from benchmark.common.tables import markdown_table
from benchmark.reporting.claims import RULES
from benchmark.reporting.comparisons import DIFFERENCES_RULE
from benchmark.reporting.copies import COPIES_RULE, without_copies
from benchmark.reporting.estimates import FEWEST_RUNS
from benchmark.reporting.scores import FAILURE_RULE, Study, score_table
from benchmark.reporting.sections import Picture, fold
from benchmark.reporting.side_runs import SIDE_RUNS_RULE
from benchmark.reporting.verdicts import Finding

TITLE = "# Results of sweeps"
READING = f"""\
## How to read this page

A run's score, its *final return*, is the mean return of its final model over {FINAL_EPISODES} episodes, which are the same for
all runs on a task. {FAILURE_RULE}

{COPIES_RULE}

Numbers that seem to contradict each other:

- The last point of a learning curve is not the final return: it is the mean over the few episodes of one evaluation, which
  begin in other states. Until an offline variant's policy is trained, at the end, its curve is that of CEM; its final return
  is the policy's.
- The interquartile mean of the final returns is not their mean: it leaves out the lowest and the highest quarter of the runs.
  Of four runs it is the mean of the middle two, so that one run that failed changes the mean and the interval alone. Tables
  of final returns have both; differences between methods are differences of means{{means}}.
- The same method, task and number of steps can have other numbers in other studies and on other pages: hyperparameters, the
  number of random steps at the start and the networks differ. Each study's section lists its own.

The intervals do not contain the variance of the mean over other episodes, so small differences may be due to these episodes.
The figures and tables of a study use its own runs, and the figure of all sweeps together those of the studies that its
caption names{{claims}}. {SIDE_RUNS_RULE}{{papers}}

Intervals are 95 % percentile bootstrap intervals by rliable; runs are drawn within each task and configuration. Few runs make
them too narrow: on normally distributed returns, the interval of an interquartile mean of 2, 3, 4, 5, 10 runs contains the
true value in 50, 75, 88, 90, 93 % of the cases. That of 4 runs extends from the lowest to the highest: three or four of four
draws are the lowest run in 5 % of the cases. Over several configurations with 4 runs of each the interval contains the true
value in 90 % of the cases, however many configurations there are. There is no interval where a configuration has fewer than
{FEWEST_RUNS} runs.

{DIFFERENCES_RULE}"""

SHARES = (
    "Returns in this table are shares of their task's range, from 0 for the lowest return of any evaluation to 1 for the best "
    "final return."
)

# What the page adds where it judges the paper's claims
WITH_CLAIMS = {
    "means": ", those of the claims on imitation and on\n  offline training of interquartile means",
    "claims": "; the claims use those of all studies of the paper's experiments here",
    "papers": "\nThe time of inference is measured separately, by `python -m benchmark.runtime`. "
    "Figure numbers in headings are the paper's.",
}
CLAIMS = "## The paper's claims"


def introduction(studies: Sequence[Study]) -> str:
    """
    Say how many runs the page rests on, and which studies are unfinished.

    :param studies: the studies
    :return: the paragraph, in Markdown
    """
    ended = sum(len(study.records) for study in studies)
    text = f"The final returns and learning curves of {ended:,} training runs."
    table = score_table(studies)
    if copies := len(table) - len(without_copies(table)):
        text += f" {copies:,} of them are copies of others, and do not count a second time."
    unfinished = [study for study in studies if len(study.records) < study.facts["runs_planned"]]
    if unfinished:
        counts = [f"{study.name} ({len(study.records)} of {study.facts['runs_planned']} runs)" for study in unfinished]
        text += f" **Unfinished, so that results may change: {', '.join(counts)}.**"
    return text


def claims_section(findings: Sequence[Finding]) -> str:
    """
    Report on the paper's claims.

    :param findings: the findings on the claims
    :return: the section, in Markdown
    """
    rows = [[finding.claim, finding.evidence or "-", f"**{finding.verdict}**"] for finding in findings]
    table = markdown_table(["claim", "evidence (95 % interval)", "verdict"], rows, align="left")
    several = [finding for finding in findings if len(finding.parts) > 1 or any(part.note for part in finding.parts)]
    parts = [
        "\n".join([f"{finding.claim}:", "", *(f"- {part.whole_text}: {part.verdict}" for part in finding.parts)])
        for finding in several
    ]
    folds = [fold("All comparisons", *parts)] * bool(parts) + [fold("How claims are judged", RULES)]
    return "\n\n".join([CLAIMS, table, SHARES, *folds])


def pooled_section(picture: Picture, command: str) -> str:
    """
    Report on several sweeps together.

    :param picture: their stability
    :param command: the command that draws it
    :return: the section, in Markdown
    """
    return f"## All sweeps together\n\n{picture.in_words()}\n\n{fold('Command', f'`{command}`')}"


def page(sections: Sequence[str], command: str, with_claims: bool) -> str:
    """
    Return the page.

    :param sections: its sections
    :param command: the command that writes it
    :param with_claims: whether one of the sections judges the paper's claims
    :return: the page, in Markdown
    """
    reading = READING.format(**(WITH_CLAIMS if with_claims else dict.fromkeys(WITH_CLAIMS, "")))
    return "\n\n".join([TITLE, *sections, reading, fold("The command that writes this page", f"`{command}`")]) + "\n"
