"""Copies of one run, in several studies or for several values of an axis that its method ignores: they count once."""

from typing import Any

import pandas as pd

from benchmark.common.records import Record, configuration_in_words, entries_by_task

COPIES_RULE = (
    "Runs of a method on a task with the same hyperparameters, seed and number of steps are copies of one run, which counts "
    "once where runs are taken together."
)


class Configurations:
    """
    What the runs of a study were trained with.

    :param description: the study's description
    """

    def __init__(self, description: dict[str, Any]):
        # rl_zoo3 takes a second to import, and only defaults need it
        from benchmark.common.zoo import without_defaults

        self._texts = {place: without_defaults(entry) for place, entry in entries_by_task(description).items()}

    def of(self, record: Record, default: str) -> str:
        """
        Return a text that the run's copies share, but for the seed.

        :param record: a run of the study
        :param default: the text in place of the hyperparameters of a run whose study does not record them
        :return: the method, the task, the steps and the hyperparameters
        """
        place = configuration_in_words(record.method, record.settings), record.task
        return f"{record.method} {record.task} {record.steps} {self._texts.get(place, default)}"


def without_copies(table: pd.DataFrame) -> pd.DataFrame:
    """
    Keep the first of each run's copies.

    :param table: the runs' scores
    :return: the rows of different runs
    """
    return table.drop_duplicates(["trained", "seed"])
