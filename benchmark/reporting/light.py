"""Whether the light setting of CEM loses anything against the paper's: the answer of studies of learning curves with both."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmark.common.tables import markdown_table
from benchmark.reporting.comparisons import (
    HIGHER,
    LOWER,
    NOT_DISTINGUISHABLE,
    difference_in_words,
    task_difference,
)
from benchmark.reporting.estimates import FEWEST_RUNS, Estimate, number_format
from benchmark.reporting.scores import Study, by_family, score_table
from benchmark.reporting.verdicts import LIGHT, MARGIN, OURS, TOO_FEW

PAIR = (LIGHT, OURS)
RULE = f"""\
*Yes* names the tasks on which the whole interval of the difference is below 0. *No loss of more than {MARGIN:.0%}* means that
no task's interval contains one, as a share of the task's range, which begins at the lowest return of any evaluation, often
below random actions: the tables have the losses in returns, too. Everything else is *not decided*."""


@dataclass(frozen=True)
class Comparison:
    """
    The light setting against the paper's on a task.

    :param place: the task, its steps and the study
    :param reward: the difference of mean final returns
    :param share: the same as a share of the task's range
    :param form: the format of rewards
    :param failed: how many runs of each failed, which count with the task's lowest return
    """

    place: str
    reward: Estimate
    share: Estimate
    form: str
    failed: tuple[int, int]

    @property
    def word(self) -> str:
        """What the interval says."""
        return difference_in_words(self.reward)

    @property
    def shows_no_loss(self) -> bool:
        """Whether the interval contains no loss that counts."""
        return self.largest_loss is not None and self.largest_loss <= MARGIN

    @property
    def largest_loss(self) -> float | None:
        """The largest loss within the interval, as a share of the task's range; None without an interval."""
        return None if self.share.interval is None else min(max(0.0, -self.share.interval[0]), 1.0)

    @property
    def largest_loss_in_words(self) -> str:
        """The same in returns, and as a share of the task's range."""
        if self.reward.interval is None:
            return "-"
        return f"{max(0.0, -self.reward.interval[0]):{self.form}} ({_percent(self.largest_loss)})"


def light_section(studies: Sequence[Study]) -> str:
    """
    Answer whether the light setting loses anything, and where, for each experiment by itself.

    :param studies: the studies
    :return: the section, in Markdown; empty if no study without axes plans both methods
    """
    chosen = [study for study in studies if not study.axes and set(PAIR) <= set(study.methods)]
    if not chosen:
        return ""
    parts = [f"## Does {LIGHT} lose anything against {OURS}?", RULE]
    for family, members in by_family(chosen).items():
        compared, missing = _compare(members)
        parts += [f"In {family}: {answer(compared, missing)}", *([_table(compared)] if compared else [])]
    return "\n\n".join(parts)


def _compare(studies: Sequence[Study]) -> tuple[list[Comparison], list[str]]:
    """Return the comparisons of an experiment, and the tasks without runs of both methods that have not failed."""
    compared, missing = [], []
    for study in studies:
        table = score_table([study])
        for task in dict.fromkeys([*study.facts["tasks"], *study.tasks]):
            place = f"{task} ({study.name}, {study.facts['steps']:,} steps)"
            runs = table[(table["task"] == task) & table["method"].isin(PAIR)]
            reward, share = (task_difference(runs, task, PAIR, column) for column in ("score", "share"))
            if reward is None or share is None or runs["failed"].all():
                missing.append(place)
            else:
                form = number_format(table[table["task"] == task]["score"])
                light, ours = (int(runs[runs["method"] == method]["failed"].sum()) for method in PAIR)
                compared.append(Comparison(place, reward, share, form, (light, ours)))
    return compared, missing


def _table(compared: Sequence[Comparison]) -> str:
    """Tabulate the comparisons, in Markdown."""
    loss = "largest loss in the interval (of the task's range)"
    header = ["task", f"{LIGHT} − {OURS} (95 % interval)", f"{LIGHT} is", loss, "seeds"]
    rows = [
        [each.place, each.reward.in_words(each.form), each.word, each.largest_loss_in_words, str(each.reward.runs)]
        for each in compared
    ]
    return markdown_table(header, rows)


def answer(compared: Sequence[Comparison], missing: Sequence[str]) -> str:
    """
    Answer in sentences.

    :param compared: the comparisons
    :param missing: the tasks on which one of the two methods has no run yet, or all runs of both failed
    :return: the answer, in Markdown
    """

    def places(word: str) -> str:
        return ", ".join(each.place for each in compared if each.word == word)

    total = len(compared) + len(missing)
    decided = [each for each in compared if each.word != TOO_FEW]
    losses = [
        f"{each.place} by {each.reward.negative().in_words(each.form)}, {_percent(-each.share.value)} of the task's range"
        for each in decided
        if each.word == LOWER
    ]
    if losses:
        sentences = [f"**Yes, on {'; '.join(losses)}.**"]
    elif decided:
        higher = sum(each.word == HIGHER for each in decided)
        is_no = len(decided) == total and all(each.shows_no_loss for each in decided)
        answer_word = f"No loss of more than {MARGIN:.0%} of a task's range" if is_no else "Not decided"
        counted = f"higher on {higher}, lower on none, and not distinguishable on {len(decided) - higher}"
        sentences = [f"**{answer_word}: of {total} tasks, {LIGHT} is {counted}.**"]
    else:
        sentences = [f"**Not known yet: on no task have {FEWEST_RUNS} seeds of both methods ended.**"]
    failures = [
        f"{each.failed[0]} of {LIGHT} and {each.failed[1]} of {OURS} on {each.place}" for each in compared if any(each.failed)
    ]
    if failures:
        sentences.append(f"**Runs failed:** {', '.join(failures)}; they count with the task's lowest return.")
    if places(HIGHER):
        sentences.append(f"{LIGHT} is higher on {places(HIGHER)}.")
    if places(NOT_DISTINGUISHABLE):
        open_ = [each for each in decided if each.word == NOT_DISTINGUISHABLE]
        worst = max(open_, key=lambda each: each.largest_loss or 0.0)
        sentences.append(
            f"The two are not distinguishable on {places(NOT_DISTINGUISHABLE)}, which is no proof that they are equal: the "
            f"intervals contain losses of up to {_percent(worst.largest_loss)} of a task's range, on {worst.place}."
        )
    if places(TOO_FEW):
        sentences.append(f"Too few seeds have ended on {places(TOO_FEW)}.")
    if missing:
        sentences.append(f"No runs of both have ended, or all have failed, on {', '.join(missing)}.")
    return " ".join(sentences)


def _percent(share: float | None) -> str:
    if share is None:
        return "-"
    return "below 0.1%" if 0 < share < 0.001 else f"{share:.1%}" if 0 < share < 0.01 else f"{share:.0%}"
