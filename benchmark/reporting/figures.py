"""The figures of studies, which follow from their runs, and the page that shows them with the commands that draw them."""

import dataclasses
import itertools
import json
import re
import shlex
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark.common.records import RUNS
from benchmark.reporting.claims import NOT_THE_PAPERS, findings
from benchmark.reporting.comparisons import experiments_section
from benchmark.reporting.drawing import final_rewards, sensitivity, stability, values
from benchmark.reporting.estimates import REPETITIONS
from benchmark.reporting.learning_curves import curves_by_minutes, curves_by_steps, timed_runs
from benchmark.reporting.light import light_section
from benchmark.reporting.literature import published
from benchmark.reporting.page import Picture, claims_section, page, pooled_section, study_section
from benchmark.reporting.scores import Study, axis_in_words, longest, read_study, score_table
from sb3_cgp.common.files import write_atomically

# Not tracked by git, unlike this repository's own results in benchmark/results/sweeps
FOLDER = Path("results/sweeps")
RUNTIME = Path(__file__).parent.parent / "results/runtime/runtime.json"
PAGE = "results.md"
FIGURES = "figures"
FIGURES_ONLY = "--figures-only"
CURVES = (
    "Learning curves on {}: every seed (thin), the interquartile mean over seeds (bold), and its 95 % interval (band). "
    "Until an offline variant's policy is trained, at the end, its curve is CEM's."
)
LITERATURE = " Hollow markers are mean returns from the literature, on other versions of the environment (table below)."
MINUTES = (
    "The same on {} by minutes of processor time, of all threads, evaluations included. A run's evaluation is placed at the "
    "run's time times the evaluation's step divided by the run's steps, and a method's curve at the mean over its runs."
)
STABILITY = (
    "Stability: the share of runs, {}, that reach at least a final reward, with pointwise 95 % bands, "
    "from the lowest reward on at which methods are more than 10 % apart."
)


def study_folders(out: Path = FOLDER) -> list[Path]:
    """
    Return the folders of all studies.

    :param out: the folder of the results
    :return: their folders, by name
    """
    return sorted(runs.parent for runs in out.glob(f"*/{RUNS}"))


def figures(folders: Sequence[Path], out: Path = FOLDER, repetitions: int = REPETITIONS, with_page: bool = True) -> Path:
    """
    Draw the figures of studies, and write their page.

    :param folders: the studies' folders
    :param out: the folder of the page and the figures
    :param repetitions: number of bootstrap samples
    :param with_page: whether the page is written; if not, an earlier one stays
    :return: the page
    :raises FileNotFoundError: if a folder holds no study
    :raises ValueError: if two have the same name
    """
    studies = [read_study(folder) for folder in folders]
    names = [study.name for study in studies]
    if len(set(names)) < len(names):
        raise ValueError(f"Two of these studies have the same name: {', '.join(names)}")
    in_earnest = longest(studies)
    together = stability_together(in_earnest, repetitions)
    pictures = [draw(study, repetitions) for study in studies]
    for picture in [*together, *itertools.chain(*pictures)]:
        write_atomically(out / picture.path, picture.content)
    if with_page:
        papers = [study for study in in_earnest if study.facts["experiment"] not in NOT_THE_PAPERS]
        found = findings(score_table(papers), read_runtime(out), repetitions)
        command = command_line(folders, out, repetitions)
        answers = list(filter(None, [light_section(studies), experiments_section(in_earnest, repetitions)]))
        claims = claims_section(found)
        pooled = [pooled_section(picture, f"{command} {FIGURES_ONLY}") for picture in together]
        results = []
        for study, own in zip(studies, pictures, strict=True):
            # A study's figures depend on nothing else
            drawing = f"{command_line([study.folder], out, repetitions)} {FIGURES_ONLY}"
            results.append(study_section(with_results_folder(study, out), own, drawing, repetitions))
        if any(is_papers(study) for study in studies):
            sections = [claims, *answers, *pooled, *results]
        else:
            # The user's findings come first, and the paper's claims last
            sections = [*answers, *results, claims, *pooled]
        sections.append(f"`{command}` writes this page.")
        write_atomically(out / PAGE, page(sections).encode())
    return out / PAGE


def is_papers(study: Study) -> bool:
    """
    Return whether a study is one of the paper's experiments.

    :param study: the study
    :return: whether it is of E1 to E8, whatever its tasks and lengths
    """
    return re.fullmatch(r"e\d+", study.facts["experiment"]) is not None and study.facts["experiment"] not in NOT_THE_PAPERS


def with_results_folder(study: Study, out: Path) -> Study:
    """
    Return a study whose commands name the folder of the results, which their records leave out as private.

    :param study: the study
    :param out: the folder of the page and the figures
    :return: the study; unchanged where the folder is the default of ``benchmark.sweep``
    """
    if shown(out) == FOLDER.as_posix():
        return study
    commands = [
        {**command, "command": f"{command['command']} {shlex.join(['--results', shown(out)])}"}
        for command in study.facts["commands"]
    ]
    return dataclasses.replace(study, facts={**study.facts, "commands": commands})


def shown(path: Path) -> str:
    """
    Return a path as commands name it.

    :param path: the path
    :return: the path from the present folder, if it is in there
    """
    here = Path.cwd()
    return (path.resolve().relative_to(here) if path.resolve().is_relative_to(here) else path).as_posix()


def command_line(folders: Sequence[Path], out: Path, repetitions: int) -> str:
    """
    Return the command that draws the same figures.

    :param folders: the studies' folders
    :param out: the folder of the page and the figures
    :param repetitions: number of bootstrap samples
    :return: the command
    """
    arguments = [shown(folder) for folder in folders]
    if shown(out) != FOLDER.as_posix():
        arguments += ["--folder", shown(out)]
    if repetitions != REPETITIONS:
        arguments += ["--repetitions", str(repetitions)]
    return shlex.join(["python", "-m", "benchmark.figures", *arguments])


def read_runtime(out: Path) -> dict[str, Any] | None:
    """
    Read the record of ``benchmark.runtime``.

    :param out: the folder of the page
    :return: the record in the folder beside it, or this repository's; None without one
    """
    own = out.parent / "runtime/runtime.json"
    return next((json.loads(path.read_text()) for path in (own, RUNTIME) if path.is_file()), None)


def draw(study: Study, repetitions: int = REPETITIONS) -> list[Picture]:
    """
    Draw a study's figures: with axes, its stability and its sensitivity; without, its learning curves and final rewards.

    :param study: the study
    :param repetitions: number of bootstrap samples
    :return: the figures; none before the first run has ended
    """
    if not study.records:
        return []
    table = score_table([study])

    names = task_names(list(dict.fromkeys([*study.facts["tasks"], *study.tasks])))

    def picture(kind: str, caption: str, content: bytes, task: str | None = None) -> Picture:
        name = kind if task is None else f"{kind}_{names[task]}"
        return Picture(f"{FIGURES}/{study.name}/{name}.png", caption, content)

    if not study.axes:
        pictures = []
        for task in study.tasks:
            drawn = curves_by_steps(study, task, repetitions)
            caption = CURVES.format(task) + LITERATURE * bool(published(task, study.facts["steps"]))
            pictures.append(picture("learning_curves", caption, drawn, task))
            if timed_runs(study, task)[0]:
                drawn = curves_by_minutes(study, task, repetitions)
                pictures.append(picture("learning_curves_by_minutes", minutes_caption(study, task), drawn, task))
        final = "Final rewards: interquartile mean, its 95 % interval, and every run as a stroke."
        return [*pictures, picture("final_rewards", final, final_rewards(study, table, repetitions))]

    axes = " and ".join(axis_in_words(axis) for axis in study.axes)
    caption = STABILITY.format("of all configurations and seeds")
    pictures = [picture("stability", caption, stability(table, study.methods, repetitions))]
    for task in study.tasks:
        lines = f"Sensitivity to {axes} on {task}: learning curves, means over seeds, on one vertical scale."
        pictures.append(picture("sensitivity", lines, sensitivity(study, task), task))
        points = f"Final rewards on {task} by {axes}: interquartile means over all runs with a value, and 95 % intervals."
        pictures.append(picture("values", points, values(study, table, task, repetitions), task))
    return pictures


def minutes_caption(study: Study, task: str) -> str:
    """
    Return the caption of learning curves by minutes.

    :param study: the study
    :param task: the task
    :return: the caption, with the number of runs that are left out, and a warning if the runs were on several machines
    """
    left_out = sum(record.task == task for record in study.records) - len(timed_runs(study, task)[0])
    machines = [command["machine"] for command in study.facts["commands"]]
    processors = dict.fromkeys(str(machine["gpu"] or machine["cpu"]) for machine in machines)
    sentences = [MINUTES.format(task)]
    if any(record.task == task and record.population > 1 for record in study.records):
        sentences.append("The time of runs that were trained as one population is the process's, divided by their number.")
    if left_out:
        sentences.append(f"Left out: {left_out} run{'s' * (left_out > 1)} without a recorded time.")
    if len(processors) > 1:
        sentences.append(f"The runs were on different machines ({', '.join(processors)}), so their times differ.")
    return " ".join(sentences)


def task_names(tasks: Sequence[str]) -> dict[str, str]:
    """
    Return names of tasks for the files of figures.

    :param tasks: the ids of a study's tasks
    :return: by id, a name without a slash; that of an id whose name another one has, too, ends with the id's checksum
    """
    names = {task: re.sub(r"[^\w.-]+", "_", task) for task in tasks}
    count = Counter(names.values())
    return {task: name if count[name] == 1 else f"{name}-{zlib.crc32(task.encode()):08x}" for task, name in names.items()}


def stability_together(studies: Sequence[Study], repetitions: int = REPETITIONS) -> list[Picture]:
    """
    Draw the stability of several sweeps together.

    Sweeps belong together that have two methods in common; a sweep that shares one method answers another question.

    :param studies: the studies
    :param repetitions: number of bootstrap samples
    :return: the figure of the largest group of sweeps; none without a group of two
    """
    groups: list[list[Study]] = []
    for study in studies:
        if study.axes:
            fitting = [group for group in groups if any(len({*study.methods} & {*other.methods}) >= 2 for other in group)]
            groups = [group for group in groups if group not in fitting]
            groups.append([member for group in fitting for member in group] + [study])
    largest = max(groups, key=len, default=[])
    if len(largest) < 2:
        return []
    methods = list(dict.fromkeys(method for study in largest for method in study.methods))
    caption = STABILITY.format(f"of all sweeps ({', '.join(study.name for study in largest)}) that name the method")
    return [Picture(f"{FIGURES}/stability.png", caption, stability(score_table(largest), methods, repetitions))]
