"""
Run a list of measurements on a GPU that is available for a short time: the tests that need one, the speed of populations, and
the paper's sweeps as populations, the most valuable first.

``python -m benchmark.gpu_list --minutes 9`` ends within nine minutes, and the same command continues. A completed step is
skipped unless its command has changed; a stopped one continues from its files, and a stopped test file starts again.
``--rehearse`` runs all steps on the CPU, with tiny settings, in a folder of its own.
"""

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmark.common.arguments import add_epilog, count, output_folder
from benchmark.common.listed_steps import FAILED, Step, do_steps, read_record
from sb3_cgp.common.files import write_atomically

ROOT = Path(__file__).parents[1]
TESTS = ("cuda_graphs_gpu", "device_replay", "population_cuda_graphs", "resume", "parity", "learning")
# Sweeps on HalfCheetah-v5 in the order of their value, and e1 on its other tasks
SWEEPS = ("e6", "e4", "e7", "e8", "e3", "e1")
OTHER_TASKS = ("Humanoid-v5", "Hopper-v5", "Pusher-v5", "Ant-v5")
LIGHT = "CGP-Light"
# Taken where a sweep's file has them; CGP-Light is added to all
METHODS = ("CGP-Online", LIGHT, "TD3")
# Further ones of e3, which compares the variants
VARIANTS = ("QGP-Online", "CGP-Offline", "QGP-Offline")
# Of a rehearsal
TINY = (
    *("--device", "cpu", "--env", "Pendulum-v1", "--numbers", "1", "2", "--methods", "TD3", "--no-estimate"),
    *("--rounds", "1", "--steps", "2", "--processes", "1"),
)
TINY_SWEEP = ("--seeds", "1", "--eval-episodes", "1", "--set", "policy_kwargs=dict(net_arch=[8,8])")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: the parsed arguments
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmark.gpu_list",
        description="Run the tests that need a GPU, the measurement of populations and sweeps, within the time of a GPU.",
    )
    parser.add_argument("--minutes", type=float, help="end within this time (default: no limit)")
    parser.add_argument("--steps", type=count, default=300_000, help="environment steps of each run (default: %(default)s)")
    parser.add_argument("--population", type=count, default=32, help="runs of one population, at most (default: %(default)s)")
    parser.add_argument("--workers", type=count, default=1, help="processes of each sweep (default: %(default)s)")
    parser.add_argument("--folder", type=output_folder, default="results/gpu_list", help="folder (default: %(default)s)")
    parser.add_argument("--only", nargs="+", help="names of steps to run (default: all)")
    parser.add_argument("--retry", action="store_true", help="repeat failed steps")
    parser.add_argument(
        "--rehearse", action="store_true", help="run all steps on the CPU, with tiny settings, in --folder/rehearsal"
    )
    parser.add_argument("--list", action="store_true", help="print the steps and their states")
    add_epilog(
        parser,
        "examples:\n  python -m benchmark.gpu_list --minutes 9\n  python -m benchmark.gpu_list --rehearse",
        "It takes hours of a GPU, in as many calls as are made.",
        "The same command continues. Logs, results, and the list's own record, gpu_list.json, are written to --folder.",
    )
    args = parser.parse_args(argv)
    if args.rehearse:
        args.folder = args.folder / "rehearsal"
    return args


def list_steps(args: argparse.Namespace) -> list[Step]:
    """
    List the steps, the most valuable first.

    :param args: the command line
    :return: the steps
    """
    python = (sys.executable, "-m")
    # The tests with "graphs" in their names have a stand-in for a GPU
    names, which = (TESTS[2:3], "recorded_gradient_steps") if args.rehearse else (TESTS, "gpu or graphs")
    pytest = (*python, "pytest", "-q", "-p", "no:cacheprovider", "-k", which)
    sizes = TINY if args.rehearse else ("--device", "cuda")
    population = (*python, "benchmark.population", "--folder", str(args.folder / "population"), *sizes)
    return [
        *(Step(f"test_{name}", (*pytest, f"tests/test_{name}.py"), continues=False) for name in names),
        Step("population", population, takes_minutes=True),
        *(Step(name, (*python, "benchmark.sweep", *sweep_options(name, args))) for name in SWEEPS),
    ]


def sweep_content(name: str) -> dict[str, Any]:
    """
    Return the content of a sweep's file: the paper's sweep, with CGP-Light among its methods.

    :param name: the sweep
    :return: the content
    """
    content: dict[str, Any] = yaml.safe_load((ROOT / "hyperparams" / "sweeps" / f"{name}.yml").read_text())
    content["methods"] = list(dict.fromkeys([*content["methods"], LIGHT]))
    return content


def sweep_file(name: str, args: argparse.Namespace) -> Path:
    """
    Return the path of a sweep's file.

    :param name: the sweep
    :param args: the command line
    :return: the path
    """
    return Path(args.folder / "sweeps" / f"{name}.yml")


def write_sweep_files(args: argparse.Namespace) -> None:
    """
    Write the files of all sweeps.

    :param args: the command line
    """
    for name in SWEEPS:
        write_atomically(sweep_file(name, args), yaml.safe_dump(sweep_content(name), sort_keys=False).encode())


def sweep_options(name: str, args: argparse.Namespace) -> list[str]:
    """
    Return the arguments of a sweep.

    :param name: the sweep
    :param args: the command line
    :return: the arguments
    """
    content, file = sweep_content(name), sweep_file(name, args)
    wanted = (*METHODS, *VARIANTS) if name == "e3" else METHODS
    methods = [method for method in wanted if method in content["methods"]]
    tasks, steps, device = list(content["tasks"]), args.steps, "cuda"
    further: Sequence[str] = ()
    if name == "e1":
        tasks = list(OTHER_TASKS)
    if args.rehearse:
        methods, tasks, steps, device, further = ["CGP-Online", LIGHT], ["Pendulum-v1"], 40, "cpu", TINY_SWEEP
    folder = file.parent
    return [
        *(str(file), "--study", name, "--task", *tasks, "--steps", str(steps), "--methods", *methods, *further),
        *("--population", str(args.population), "--device", device, "--workers", str(args.workers)),
        *("--storage", f"sqlite:///{folder / 'studies.db'}"),
        *("--logs", str(folder / "logs"), "--results", str(folder / "results")),
    ]


def main(argv: Sequence[str] | None = None) -> None:
    """
    Do the list.

    :param argv: the command line; None for that of the process
    """
    args = parse(sys.argv[1:] if argv is None else argv)
    args.folder = args.folder.absolute()
    steps = list_steps(args)
    unknown = sorted(set(args.only or []) - {step.name for step in steps})
    if unknown:
        sys.exit(f"Error: --only {' '.join(unknown)}: must be of {', '.join(step.name for step in steps)}")
    try:
        record = read_record(args)
    except ValueError as error:
        sys.exit(f"Error: {error}")
    if args.list:
        for step in steps:
            print(f"{step.name}: {step.recorded(record).get('state', 'to do')}: {' '.join(step.command[1:])}")
        return
    # `sys.exit` ends the step, too
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    write_sweep_files(args)
    record = do_steps(steps, args)
    if any(step.recorded(record).get("state") == FAILED for step in steps):
        sys.exit(1)


if __name__ == "__main__":
    main()
