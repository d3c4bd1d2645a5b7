"""The time from an observation to an action: by ``predict``, by the exported ONNX, and by the policy loaded without pickle."""

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table
from benchmark.speed.timing import interleaved, ratio, summary
from sb3_cgp import CGP
from sb3_cgp.common.extras import import_from_extra

# Before the first measurement
onnxruntime, *_ = (
    import_from_extra(name, "export", "A measurement of exports")
    for name in ("onnxruntime", "onnx", "onnxscript", "safetensors")
)
PREDICT, WEIGHTS, ONNX = "`predict`", "`load_weights`", "onnxruntime"
NOTES = """\
Microseconds per action on {env}, one observation at a time, of an untrained policy of the default size: medians of {rounds}
rounds of {actions} actions each, taken in turn; the quartiles beside them. "/ predict" is the median of the ratios within
each round. The exported policies compute on the CPU; the network that `predict` asks lies on {device}."""


def ways_to_act(model: CGP, folder: Path, threads: int) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """
    Export a model, and return the ways to compute an action of its policy.

    :param model: the model
    :param folder: the folder of the export
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


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure all ways to compute an action.

    :param args: the command line
    :return: under "ways", seconds per action and the ratio to ``predict``, by name
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
        "ways": {
            name: {"seconds": summary(times), "ratio_to_predict": ratio(times, seconds[PREDICT])}
            for name, times in seconds.items()
        }
    }


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: the measurements and their conditions
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
