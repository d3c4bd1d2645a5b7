"""The processors on which the methods of a study were trained."""

from collections.abc import Sequence
from itertools import combinations

from benchmark.common.provenance import processors_of_commands
from benchmark.common.records import Record
from benchmark.reporting.scores import Study

CONSEQUENCE = (
    "Small differences between methods that have no processor in common may come from the processor, from CEM's data type on "
    "it, or from versions of packages: the commands below list them."
)


def processors_of_run(study: Study, run: Record) -> list[str]:
    """
    List the processors that may have trained a run.

    :param study: the study
    :param run: one of its runs
    :return: those of all of the study's commands for a run that does not have its own
    """
    return run.processors or processors_of_commands(study.facts["commands"])


def processors_of_runs(study: Study, runs: Sequence[Record]) -> list[str]:
    """
    List the processors that may have trained runs.

    :param study: the study
    :param runs: some of its runs
    :return: the processors, each once, in alphabetical order
    """
    return sorted({name for run in runs for name in processors_of_run(study, run)})


def different_processors(study: Study) -> list[str]:
    """
    Say on which processors each method was trained, where two methods have none in common.

    :param study: the study
    :return: a paragraph, in Markdown; none where every two methods share a processor
    """
    methods: dict[tuple[str, ...], list[str]] = {}
    for method in study.methods:
        names = processors_of_runs(study, [record for record in study.records if record.method == method])
        if names:
            methods.setdefault(tuple(names), []).append(method)
    if all(set(first) & set(second) for first, second in combinations(methods, 2)):
        return []
    places = "; ".join(f"{', '.join(some)} on {' and '.join(names)}" for names, some in methods.items())
    return [f"Methods were trained on different processors: {places}. {CONSEQUENCE}"]
