"""The run-time table in Markdown, with the notes on it."""

from typing import Any

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table
from benchmark.speed.contenders import BATCH_SIZE, NET_ARCH, REFERENCE

NOTES = f"""\
Seconds per episode of {{steps:,}} environment steps of {{env}}: median (quartiles) of {{episodes}} training episodes and
{{inference_episodes}} inference episodes per method, taken in turn. A ratio is the median of the ratios to {REFERENCE}
within each round; the paper's ratios are to its own {REFERENCE}, on a GTX 1080 Ti.

Training is `learn` with one gradient step per environment step, after {{steps:,}} random steps and {{burn_in:,}} untimed
gradient steps; inference is `predict(deterministic=True)` and a step of the environment. All with batch size {BATCH_SIZE},
hidden layers {NET_ARCH}, no exploration noise, and otherwise their authors' defaults: two critics (DDPG one), TQC's with
25 quantiles each, CrossQ's with batch normalisation and without targets. CGP-2-plain repeats the observation for every
sample, in float32. SBX's TD3 computes with JAX, on JAX's own threads and default device."""


def cells(measured: dict[str, Any] | None) -> list[str]:
    """
    Return a time as three cells of the table.

    :param measured: seconds and ratios; None if the method was not timed
    :return: seconds, ratio and the paper's ratio, "-" for a missing one
    """
    if measured is None:
        return ["-", "-", "-"]
    seconds = measured["seconds"]
    ratios = ["-" if value is None else f"{value:.2f}" for value in (measured["ratio"], measured["paper_ratio"])]
    return [f"{seconds['median']:.3g} ({seconds['lower']:.3g}-{seconds['upper']:.3g})", *ratios]


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: the measurements and their conditions
    :return: the table and its notes, in Markdown
    """
    header = ["method", "train, s", f"/ {REFERENCE}", "paper", "inference, s", f"/ {REFERENCE}", "paper"]
    rows = [
        [
            name,
            *([method["missing"]] + [""] * 5 if "missing" in method else cells(method["train"]) + cells(method["inference"])),
        ]
        for name, method in record["methods"].items()
    ]
    notes = NOTES.format(
        steps=record["episode_steps"],
        env=record["env"],
        episodes=record["episodes"],
        inference_episodes=record["inference_episodes"],
        burn_in=record["burn_in_steps"],
    )
    return "\n\n".join(["# Run time", markdown_table(header, rows), notes, conditions_in_words(record)]) + "\n"
