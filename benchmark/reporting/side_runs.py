"""Runs that are shown by themselves, but do not count where studies are taken together: short trials and variations."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from benchmark.common.records import Record, entries_by_task
from benchmark.reporting.estimates import FEWEST_RUNS
from benchmark.reporting.scores import Study

SIDE_RUNS_RULE = (
    "Shorter runs of an experiment on a task are left out of them where longer ones have all of their methods, with as many "
    f"runs or {FEWEST_RUNS}. So are runs of a study with other hyperparameters, where another study has runs of the same "
    "length of all their methods and of others."
)


def without_side_runs(studies: Sequence[Study]) -> list[Study]:
    """
    Return the studies without short trials and variations, which must not weigh as much as an experiment's main runs.

    :param studies: the studies
    :return: the studies without such runs, as :data:`SIDE_RUNS_RULE` defines them; those that have no others are left out
    """
    by_steps: dict[tuple[str, str], dict[int, Counter[str]]] = {}
    by_study: dict[tuple[str, str, int], dict[str, set[str]]] = {}
    for study in studies:
        for record in study.records:
            of_steps = by_steps.setdefault((record.experiment, record.task), {})
            of_steps.setdefault(record.steps, Counter())[record.method] += 1
            of_study = by_study.setdefault((record.experiment, record.task, record.steps), {})
            of_study.setdefault(study.name, set()).add(record.method)
    configurations = {study.name: entries_by_task(study.facts) for study in studies}

    def is_trial(record: Record) -> bool:
        numbers = by_steps[record.experiment, record.task]
        enough = Counter({method: min(number, FEWEST_RUNS) for method, number in numbers[record.steps].items()})
        return any(steps > record.steps and enough <= longer for steps, longer in numbers.items())

    def is_variation(record: Record, name: str) -> bool:
        methods = by_study[record.experiment, record.task, record.steps]
        mains = [other for other, more in methods.items() if methods[name] < more]
        own = configurations[name]
        return any(
            own[each] != configurations[main][each] for main in mains for each in own.keys() & configurations[main].keys()
        )

    kept = []
    for study in studies:
        records = [record for record in study.records if not is_trial(record) and not is_variation(record, study.name)]
        if records:
            # A task without runs yet is still planned
            left_out = {record.task for record in study.records} - {record.task for record in records}
            tasks = [task for task in study.facts["tasks"] if task not in left_out]
            kept.append(replace(study, records=records, facts=study.facts | {"tasks": tasks}))
    return kept
