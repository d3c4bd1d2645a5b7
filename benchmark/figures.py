"""
Draw the figures of sweeps, and write the page on their results.

``python -m benchmark.figures results/sweeps/e3 …`` takes the folders of studies, or names of studies in a storage,
and writes ``results.md`` and ``figures/`` into the folder of the results.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmark.common.arguments import add_epilog, count, output_folder
from benchmark.reporting.estimates import REPETITIONS
from benchmark.reporting.figures import FIGURES, FIGURES_ONLY, FOLDER, PAGE, figures, study_folders
from benchmark.reporting.scores import read_study
from benchmark.reporting.summary import summary
from sb3_cgp.common.files import write_atomically


def main(argv: Sequence[str] | None = None) -> None:
    """
    Draw the figures of the studies that the command line names, and write their page.

    :param argv: the command line; None for that of the process
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.figures", description="Draw the figures of sweeps, and write the page on their results."
    )
    parser.add_argument(
        "studies", nargs="*", metavar="STUDY", help="a study's folder, or its name in the storage (default: all in --folder)"
    )
    parser.add_argument("--folder", type=output_folder, default=FOLDER, help="folder of the results (default: %(default)s)")
    parser.add_argument("--storage", help="URL of the database that holds named studies")
    parser.add_argument(
        "--repetitions", type=count, default=REPETITIONS, help="number of bootstrap samples (default: %(default)s)"
    )
    parser.add_argument(FIGURES_ONLY, action="store_true", help="draw the figures, and leave the page as it is")
    parser.add_argument(
        "--summary",
        type=Path,
        metavar="FILE",
        help="draw one figure into FILE, and nothing else: the learning curves of the first STUDY's first task, and the "
        "stability of the second STUDY, a sweep over hyperparameters",
    )
    add_epilog(
        parser,
        "examples:\n"
        "  python -m benchmark.figures\n"
        "  python -m benchmark.figures results/sweeps/e3-Pendulum-v1\n"
        "  python -m benchmark.figures --folder benchmark/results/sweeps\n"
        "  python -m benchmark.figures e3-Pendulum-v1 --storage sqlite:///logs/sweeps/studies.db\n"
        "  python -m benchmark.figures e1-Pendulum-v1 e6-Pendulum-v1 --summary summary.png",
        "It takes seconds to minutes. results.md and figures/ are written to --folder; the third example is for this\n"
        "repository's own results.",
    )
    args = parser.parse_args(argv)
    # A shell's * names the folder of the figures and the page, too
    named = [study for study in args.studies if Path(study) not in (args.folder / FIGURES, args.folder / PAGE)]
    if args.storage is not None and not named:
        parser.error("argument --storage: name the studies to take from it")
    try:
        folders = [find(study, args.storage, args.folder) for study in named] or study_folders(args.folder)
        if not folders:
            raise FileNotFoundError(f"{args.folder} holds no study")
        if args.summary is not None:
            if len(named) != 2:
                parser.error("argument --summary: name two studies, one of learning curves and one of hyperparameters")
            learning, sweep = map(read_study, folders)
            write_atomically(args.summary, summary(learning, sweep, args.repetitions))
            print(args.summary)
            return
        print(figures(folders, args.folder, args.repetitions, not args.figures_only))
    except (FileNotFoundError, ValueError) as error:
        sys.exit(f"Error: {error}")


def find(study: str, storage: str | None, out: Path) -> Path:
    """
    Return a study's folder; export the study into it if it is in a storage.

    :param study: its folder or its name
    :param storage: the URL of the storage; None for a study that is a folder
    :param out: the folder of all results
    :return: its folder
    :raises FileNotFoundError: if the folder is missing, or the storage has no such study
    :raises ValueError: if the storage does not answer
    """
    if storage is None:
        for folder in (Path(study), out / study):
            if folder.is_dir():
                return folder
        raise FileNotFoundError(f"{study} is no folder; to take a study of that name from a storage, name it with --storage")
    # Optuna takes a second to import, and only studies of a storage need it
    from benchmark.sweeps.exports import export_study
    from benchmark.sweeps.storages import StorageError, without_password

    try:
        return export_study(study, storage, out)
    except KeyError as error:
        raise FileNotFoundError(f"The storage {without_password(storage)} holds no sweep {study}") from error
    except StorageError as error:
        raise ValueError(f"the storage does not answer: {error}") from error


if __name__ == "__main__":
    main()
