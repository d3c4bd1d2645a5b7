"""
The time from an observation to an action: ``predict``, the exported ONNX, and the policy loaded without pickle.

``python -m benchmark.latency`` writes ``latency.md`` and ``latency.json``.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnxruntime
import torch as th

from benchmark.common.arguments import continuous_environment, count, measuring_parser
from benchmark.common.files import markdown_table, publish
from benchmark.common.provenance import conditions, conditions_in_words
from benchmark.speed.timing import interleaved, ratio, summary
from sb3_cgp import CGP

PREDICT, WEIGHTS, ONNX = "`predict`", "`load_weights`", "onnxruntime"
NOTES = """\
Microseconds per action on {env}, one observation at a time, of an untrained policy of the default size: medians of {rounds}
rounds of {actions} actions each, taken in turn; the quartiles beside them. "/ predict" is the median of the ratios within
each round. The exported policies compute on the CPU; the network that `predict` asks lies on {device}."""


def ways_to_act(model: CGP, folder: Path, threads: int) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """
    Export a model, and list the ways to ask its policy.

    :param model: the model
    :param folder: where to export it to
    :param threads: onnxruntime's threads
    :return: functions from an observation, of the environment's shape, to an action, by name
    """
    model.export(folder)
    policy = CGP.load_weights(folder)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(folder / "policy.onnx", options, providers=["CPUExecutionProvider"])
    return {
        PREDICT: lambda observation: model.predict(observation, deterministic=True)[0],
        WEIGHTS: lambda observation: policy.predict(observation)[0],
        ONNX: lambda observation: session.run(None, {"observation": observation[None]})[0][0],
    }


def measure(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """
    Measure all the ways.

    :param args: the command line
    :return: seconds per action and the ratio to ``predict``, by name
    """
    model = CGP("MlpPolicy", args.env, seed=args.seed, device=args.device, buffer_size=1)
    space = model.observation_space
    space.seed(args.seed)
    observations = [space.sample() for _ in range(args.actions)]

    def acting(act: Callable[[np.ndarray], np.ndarray]) -> Callable[[], object]:
        def run() -> None:
            for observation in observations:
                act(observation)

        return run

    with TemporaryDirectory() as folder:
        ways = ways_to_act(model, Path(folder), args.threads)
        runs = {name: acting(act) for name, act in ways.items()}
        totals = interleaved(runs, args.rounds, device=args.device, title="latency")
    seconds = {name: [total / args.actions for total in times] for name, times in totals.items()}
    return {
        name: {"seconds": summary(times), "ratio_to_predict": ratio(times, seconds[PREDICT])}
        for name, times in seconds.items()
    }


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: what was measured, and how
    :return: the table and its notes, in Markdown
    """
    header = ["way", "µs per action", "lower", "upper", "/ predict"]
    rows = []
    for name, figures in record["ways"].items():
        times = [f"{1e6 * figures['seconds'][key]:.3g}" for key in ("median", "lower", "upper")]
        rows.append([name, *times, f"{figures['ratio_to_predict']:.2f}"])
    notes = NOTES.format(
        env=record["env"], rounds=record["rounds"], actions=record["actions"], device=record["machine"]["device"]
    )
    return (
        "\n\n".join(["# From an observation to an action", markdown_table(header, rows), notes, conditions_in_words(record)])
        + "\n"
    )


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    parser = measuring_parser("latency", "Measure the time per action of a policy and of its exports.")
    parser.add_argument(
        "--env", type=continuous_environment, default="HalfCheetah-v5", help="the environment (default: %(default)s)"
    )
    parser.add_argument("--rounds", type=count, default=50, help="timed rounds (default: %(default)s)")
    parser.add_argument("--actions", type=count, default=200, help="actions per round (default: %(default)s)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """
    Measure, and write the table.

    :param argv: the command line; None for the process's own
    """
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    th.set_num_threads(args.threads)
    record = {
        **conditions("benchmark.latency", argv, args.device),
        "env": args.env,
        "seed": args.seed,
        "rounds": args.rounds,
        "actions": args.actions,
        "ways": measure(args),
    }
    publish(args.folder, "latency", record, markdown(record))


if __name__ == "__main__":
    main()
