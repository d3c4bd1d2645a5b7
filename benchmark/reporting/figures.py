"""The figures of studies, which follow from their runs, and the page that shows them with the commands that draw them."""

import itertools
import re
import sys
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark.common.files import read_json
from benchmark.common.records import RUNS
from benchmark.reporting.claims import findings
from benchmark.reporting.commands import FIGURES_ONLY, FOLDER, command_line, with_results_folder
from benchmark.reporting.comparisons import experiments_section
from benchmark.reporting.drawing import final_rewards, sensitivity, stability, values
from benchmark.reporting.estimates import REPETITIONS
from benchmark.reporting.learning_curves import curves_by_minutes, curves_by_steps, shown_methods, timed_methods, times_of
from benchmark.reporting.light import light_section
from benchmark.reporting.literature import published
from benchmark.reporting.overview import overview
from benchmark.reporting.page import claims_section, introduction, page, pooled_section
from benchmark.reporting.scores import Study, axis_in_words, experiment_number, read_study, score_table
from benchmark.reporting.sections import Picture, study_sections
from benchmark.reporting.side_runs import without_side_runs
from sb3_cgp.common.files import write_atomically

PAGE = "results.md"
FIGURES = "figures"
CURVES = (
    "Learning curves on {}: every seed (thin), the interquartile mean over seeds (bold), and its 95 % interval (band). "
    "Until an offline variant's policy is trained, at the end, its curve is CEM's. The vertical axis is that of the "
    "evaluations after the random steps at the start; untrained policies may be below it."
)
LITERATURE = " Open markers are mean returns from the literature, on other versions of the environment (table below)."
MINUTES = (
    "The same on {} by minutes of processor time, of all threads, evaluations and repeated steps after an interruption "
    "included. A run's time is shared evenly among its steps, but for the random ones at the start, which are taken to need "
    "none, and a method's curve is placed at the median over its runs."
)
SENSITIVITY = "learning curves, every seed (thin) and the interquartile mean over seeds (bold), on one vertical scale."
STABILITY = (
    "Stability: the share of runs, {}, that reach at least a final return, with pointwise 95 % bands, "
    "from the lowest return on at which methods are more than 15 percentage points apart."
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
    :raises ValueError: if a folder holds no study, a file of it is damaged, or two have the same name
    """
    studies = [read_study(folder) for folder in folders]
    names = [study.name for study in studies]
    if len(set(names)) < len(names):
        raise ValueError(f"Two of these studies have the same name: {', '.join(names)}")
    print(f"Drawing the figures of {', '.join(names)} into {out / FIGURES}", file=sys.stderr, flush=True)
    main_studies = without_side_runs(studies)
    together = stability_together(main_studies, repetitions)
    pictures = [draw(study, repetitions) for study in studies]
    for picture in [*together, *itertools.chain(*pictures)]:
        write_atomically(out / picture.path, picture.content)
    if with_page:
        write_atomically(out / PAGE, page_of(studies, main_studies, together, pictures, out, repetitions).encode())
    return out / PAGE


def page_of(
    studies: Sequence[Study],
    main_studies: Sequence[Study],
    together: Sequence[Picture],
    pictures: Sequence[Sequence[Picture]],
    out: Path,
    repetitions: int,
) -> str:
    """
    Write the page of studies.

    :param studies: the studies
    :param main_studies: those of them that claims rest on
    :param together: the figures of several studies together
    :param pictures: the figures of each study
    :param out: the folder of the page and the figures
    :param repetitions: number of bootstrap samples
    :return: the page, in Markdown
    """
    with_claims = any(is_papers(study) for study in studies)
    claims = []
    if with_claims:
        judged = score_table([study for study in main_studies if is_papers(study)])
        claims = [claims_section(findings(judged, read_runtime(out), repetitions))]
    folders = [study.folder for study in studies]
    command = command_line([] if folders == study_folders(out) else folders, out, repetitions)
    found = [
        overview(studies, repetitions),
        light_section(main_studies),
        experiments_section(main_studies),
    ]
    pooled = [pooled_section(picture, f"{command} {FIGURES_ONLY}") for picture in together]
    results = []
    for study, own in zip(studies, pictures, strict=True):
        # A study's figures depend on nothing else
        drawing = f"{command_line([study.folder], out, repetitions)} {FIGURES_ONLY}"
        results += study_sections(with_results_folder(study, out), own, drawing, out, repetitions)
    sections = [introduction(studies), *claims, *found, *pooled, *results]
    return page(list(filter(None, sections)), command, with_claims)


def is_papers(study: Study) -> bool:
    """
    Return whether a study is one of the paper's experiments, whose runs its claims are judged by.

    :param study: the study
    :return: whether it has one of this project's names, whatever its tasks and lengths, but E10's, whose tasks are others
    """
    return experiment_number(study) not in (None, 10)


def read_runtime(out: Path) -> dict[str, Any] | None:
    """
    Read the record of ``benchmark.runtime``.

    :param out: the folder of the page
    :return: the record in the folder beside it; None without one
    :raises ValueError: if it is damaged; it names the file and the remedy
    """
    path = out.parent / "runtime/runtime.json"
    remedy = "Move it away, and measure anew by `python -m benchmark.runtime`."
    return read_json(path, ["methods"], remedy) if path.is_file() else None


def draw(study: Study, repetitions: int) -> list[Picture]:
    """
    Draw a study's figures: with axes, its stability and its sensitivity; without, its learning curves and final returns.

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
        title = f"{kind.replace('_', ' ').capitalize()}, {task or ', '.join(study.tasks)}"
        return Picture(f"{FIGURES}/{study.name}/{name}.png", title, caption, content, task)

    if not study.axes:
        pictures = []
        for task in study.tasks:
            drawn = curves_by_steps(study, task, repetitions)
            caption = CURVES.format(task) + LITERATURE * bool(published(task, study.facts["steps"]))
            pictures.append(picture("learning_curves", caption, drawn, task))
            if times_of(study, task).runs:
                drawn = curves_by_minutes(study, task, repetitions)
                pictures.append(picture("learning_curves_by_minutes", minutes_caption(study, task), drawn, task))
        final = "Final returns: interquartile mean, its 95 % interval, and every run as a stroke."
        return [*pictures, picture("final_rewards", final, final_rewards(study, table, repetitions))]

    axes = " and ".join(axis_in_words(axis) for axis in study.axes)
    caption = STABILITY.format("of all configurations and seeds")
    pictures = [picture("stability", caption, stability(table, study.methods, repetitions))]
    for task in study.tasks:
        lines = f"Sensitivity to {axes} on {task}: {SENSITIVITY}"
        pictures.append(picture("sensitivity", lines, sensitivity(study, task), task))
        points = f"Final returns on {task} by {axes}: interquartile means over all runs with a value, and 95 % intervals."
        pictures.append(picture("values", points, values(study, table, task, repetitions), task))
    return pictures


def minutes_caption(study: Study, task: str) -> str:
    """
    Return the caption of learning curves by minutes.

    :param study: the study
    :param task: the task
    :return: the caption, with the number of runs that are left out, and a warning if the runs were on several machines
    """
    timed = timed_methods(study, task)
    offline = [method for method in shown_methods(study, task) if method not in timed]
    records = [record for record in study.records if record.task == task and record.method in timed]
    times = times_of(study, task)
    untimed = sum(record.processor_seconds is None for record in records)
    elsewhere = sum(record.processor_seconds is not None and record.method in times.elsewhere for record in records)
    incomplete = len(records) - untimed - elsewhere - len(times.runs)
    sentences = [MINUTES.format(task)]
    if any(record.task == task and record.population > 1 for record in study.records):
        sentences.append("The time of runs that were trained as one population is the process's, divided by their number.")
        sentences.append("On a GPU, their environments have processes of their own, whose time is not counted.")
    if offline:
        sentences.append(f"Left out, as they train their policies after the last step: {', '.join(offline)}.")
    if untimed:
        sentences.append(f"Left out: {untimed} run{'s' * (untimed > 1)} without a recorded time.")
    if incomplete:
        sentences.append(f"Left out: {incomplete} run{'s' * (incomplete > 1)} of methods without a complete run with a time.")
    if len(times.all_processors) > 1:
        is_one = len(times.processors) == 1
        consequence = f"; the times are those on {times.processors[0]}" if is_one else ", so their times cannot be compared"
        sentences.append(f"The runs were on different machines ({', '.join(times.all_processors)}){consequence}.")
    if times.elsewhere:
        sentences.append(f"Left out, as they have no run there: {', '.join(times.elsewhere)}.")
    threads = sorted({command["machine"].get("torch_threads", 1) for command in study.facts["commands"]})
    if len(threads) > 1:
        sentences.append(f"The commands used {' or '.join(map(str, threads))} threads, on which the times depend.")
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


def stability_together(studies: Sequence[Study], repetitions: int) -> list[Picture]:
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
    lacking = {study.name: [method for method in methods if method not in study.methods] for study in largest}
    missing = [f"{', '.join(lacks)} in {name}" for name, lacks in lacking.items() if lacks]
    if missing:
        caption += f" The curves rest on different configurations, as methods are missing: {'; '.join(missing)}."
    title = "Stability of all sweeps together"
    return [Picture(f"{FIGURES}/stability.png", title, caption, stability(score_table(largest), methods, repetitions))]
