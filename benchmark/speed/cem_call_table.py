"""The table of CEM calls in Markdown, with the notes on it."""

from typing import Any

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table
from benchmark.speed.products import Sizes

NOTES = """\
Milliseconds of one CEM call on a Q-network with {n_features} features, two hidden layers and ReLU: medians of {rounds}
rounds, in each of which every call of the table is timed once; one size is varied at a time around those of the first rows.
"start" is where CEM starts; the actor's actions are given, and their time does not count.
"plain" is the same call with the observation repeated for every sample, in float32, and "/ plain" the ratio to it. "of
products" is the time of the critic's matrix products alone, without activations, over the time of the call. Both are medians
of the ratios within each round.

The products are: hidden activations, (batch × samples, width), by the second layer's weights, (width, width), once per
iteration and in the same data type; and in float32 the first layer's parts for states (once) and actions, and the last
layer. For the hidden ones the fastest of PyTorch's kernels counts, in one piece and in blocks of several sizes; "of hidden"
is their share alone. GFLOP/s counts the same products."""


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: the measurements and their conditions
    :return: the table and its notes, in Markdown
    """
    header = [
        "batch × samples × iterations",
        "start",
        "actions",
        "width",
        "type",
        "ms",
        "plain",
        "/ plain",
        "GFLOP/s",
        "of products",
        "of hidden",
    ]
    rows = []
    for entry in record["calls"]:
        sizes = entry["sizes"]
        rows.append(
            [
                f"{sizes['batch']} × {sizes['samples']} × {sizes['iterations']}",
                sizes["start"],
                str(sizes["action_dim"]),
                str(sizes["width"]),
                entry["dtype"],
                f"{1e3 * entry['call_seconds']['median']:.3g}",
                f"{1e3 * entry['plain_seconds']['median']:.3g}",
                f"{entry['ratio_to_plain']:.2f}",
                f"{entry['flops_per_second'] / 1e9:.3g}",
                f"{entry['share_of_products']:.0%}",
                f"{entry['share_of_hidden_products']:.0%}",
            ]
        )
    notes = NOTES.format(n_features=Sizes().n_features, rounds=record["rounds"])
    return "\n\n".join(["# One CEM call", markdown_table(header, rows), notes, conditions_in_words(record)]) + "\n"
