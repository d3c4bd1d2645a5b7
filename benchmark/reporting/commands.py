"""The commands that the results page names."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmark.reporting.estimates import REPETITIONS
from benchmark.reporting.scores import Study

# Not tracked by git, unlike this repository's own results in benchmark/results/sweeps
FOLDER = Path("results/sweeps")
FIGURES_ONLY = "--figures-only"


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
    return replace(study, facts={**study.facts, "commands": commands})


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
