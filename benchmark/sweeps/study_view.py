"""Reading a study: its trials, its description, the runs that have ended, and those that are left."""

from collections import defaultdict
from typing import Any

from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial

from benchmark.common.records import Record
from benchmark.sweeps.runs import overview
from benchmark.sweeps.study_trials import COMMAND, KEY, SWEEP, choices_of, owned, record_of, run_of


class StudyView:
    """
    A study, to be read.

    :param storage: the storage of the study
    :param name: the study's name
    """

    def __init__(self, storage: BaseStorage, name: str):
        self.storage = storage
        self.name = name
        self._study_id: int | None = None

    @property
    def study_id(self) -> int:
        """
        The study's number in its storage.

        :raises KeyError: if the storage holds no study of the name
        """
        if self._study_id is None:
            self._study_id = self.storage.get_study_id_from_name(self.name)
        return self._study_id

    def trials(self) -> list[FrozenTrial]:
        """
        Read the study's trials, without those that another program may have added.

        :return: the trials, in their order
        """
        trials = self.storage.get_all_trials(self.study_id, deepcopy=False)
        return [trial for trial in trials if KEY in trial.user_attrs]

    def description(self) -> dict[str, Any]:
        """
        Read the description of the sweep.

        :return: the description that :meth:`~benchmark.sweeps.studies.Ledger.open` was given, with all runs that the study was
            ever given, and all commands
        """
        attributes = self.storage.get_study_user_attrs(self.study_id)
        noted = [(value["runs_ended"], name) for name, value in attributes.items() if name.startswith(COMMAND)]
        commands = [attributes[name] for _, name in sorted(noted)]
        trials = self.trials()
        runs = [run_of(trial) for trial in trials]
        given = overview(runs, choices_of(trials, "method"), choices_of(trials, "task"))
        return {**attributes[SWEEP], **given, "commands": commands}

    def left(self) -> list[str]:
        """
        List the runs that have not ended.

        :return: their keys
        """
        trials = self.trials()
        ended = {key for key, trial in owned(trials).items() if trial.state.is_finished()}
        # Trials that are not the run's own have to end, too
        left = (trial for trial in trials if trial.user_attrs[KEY] not in ended or not trial.state.is_finished())
        return list(dict.fromkeys(trial.user_attrs[KEY] for trial in left))

    def records(self) -> list[Record]:
        """
        List the runs that have ended, completed or failed with an error.

        :return: their records
        """
        trials = self.trials()
        experiment = self.storage.get_study_user_attrs(self.study_id)[SWEEP]["experiment"]
        of_run: dict[str, list[FrozenTrial]] = defaultdict(list)
        for trial in trials:
            of_run[trial.user_attrs[KEY]].append(trial)
        return [record_of(experiment, trial, of_run[key]) for key, trial in owned(trials).items() if trial.state.is_finished()]
