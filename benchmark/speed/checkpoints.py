"""The time that it takes to save and to load a whole training state, with a full replay buffer."""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table
from benchmark.speed.timing import summary, timed
from sb3_cgp import CGP
from sb3_cgp.resumption.state import gather
from sb3_cgp.resumption.store import StateStore

NOTES = """\
Seconds for which training stands still, on {env} with a replay buffer of {transitions} transitions, all of them filled, and
networks of the default size: medians of {rounds} rounds, the quartiles beside them. "First" writes all of it to an empty
folder, "second" all of it once more, {new} steps later, as two states share no file, and "later", {new} steps later again,
the changes since the first; "load" reads all of a state and verifies its checksums. On the disk: {size:.0f} MB, with
two states."""


def fill(buffer: ReplayBuffer, rows: int, generator: np.random.Generator) -> None:
    """
    Store random transitions.

    :param buffer: the buffer
    :param rows: number of transitions
    :param generator: random numbers
    """
    places = (buffer.pos + np.arange(rows)) % buffer.buffer_size
    for array in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
        array[places] = generator.standard_normal((rows, *array.shape[1:]), dtype=np.float32)
    buffer.full = buffer.full or buffer.pos + rows >= buffer.buffer_size
    buffer.pos = int((buffer.pos + rows) % buffer.buffer_size)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure saving and loading.

    :param args: the command line
    :return: under "measured", seconds by operation, and the size in bytes
    """
    generator = np.random.default_rng(args.seed)
    model = CGP("MlpPolicy", args.env, seed=args.seed, device=args.device, buffer_size=args.transitions, cuda_graphs=False)
    _, callback = model._setup_learn(1)
    assert model.replay_buffer is not None
    fill(model.replay_buffer, args.transitions, generator)
    seconds: dict[str, list[float]] = {"first": [], "second": [], "later": [], "load": []}
    for _ in range(args.rounds):
        with TemporaryDirectory(dir=args.folder) as folder:
            store = StateStore(folder)

            def save(store: StateStore = store) -> None:
                store.save(model.num_timesteps, gather(model, callback))

            for name in ("first", "second", "later"):
                seconds[name].append(timed(save))
                fill(model.replay_buffer, args.new, generator)
                model.num_timesteps += args.new
            seconds["load"].append(timed(StateStore(folder).load))
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    return {"measured": {"seconds": {name: summary(values) for name, values in seconds.items()}, "bytes": size}}


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: the measurements and their conditions
    :return: the table and its notes, in Markdown
    """
    rows = [
        [name, *(f"{figures[key]:.3g}" for key in ("median", "lower", "upper"))]
        for name, figures in record["measured"]["seconds"].items()
    ]
    notes = NOTES.format(**record, size=record["measured"]["bytes"] / 1e6)
    table = markdown_table(["", "seconds", "lower", "upper"], rows)
    return "\n\n".join(["# Saving and loading a training state", table, notes, conditions_in_words(record)]) + "\n"
