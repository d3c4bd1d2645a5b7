"""
The time of one CEM call across its sizes and data types, beside the plain way and beside bare matrix products.

``python -m benchmark.selector`` writes ``selector.md`` and ``selector.json``.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from benchmark.common.arguments import count, measuring_parser
from benchmark.common.files import markdown_table, publish
from benchmark.common.provenance import conditions, conditions_in_words
from benchmark.speed.products import Sizes, bare_products, call_flops, outer_products, product_flops
from benchmark.speed.timing import interleaved, ratio, summary
from sb3_cgp.core.cem import CEM, Score
from sb3_cgp.core.policies import repeated_q_score
from sb3_cgp.fast.scoring import q_score

DTYPES = {"float32": th.float32, "bfloat16": th.bfloat16}
VARIATIONS: dict[str, tuple[int, ...]] = {
    "batch": (1, 32, 128, 256, 512),
    "samples": (16, 32, 64, 128, 256),
    "iterations": (1, 2, 4, 8),
    "action_dim": (1, 3, 6, 17),
    "width": (64, 128, 256, 512, 1024),
}
NOTES = """\
Milliseconds of one CEM call on a Q-network with {n_features} features, two hidden layers and rectifiers: medians of {rounds}
calls, everything in the table taken in turn; one size is varied at a time around the first lines'. "/ plain" is the ratio
to the same call with the observation repeated for every sample in float32; "of products" the time of the bare products
over the call's. Both are medians of the ratios within each round.

The bare products are all the critic's: hidden activations, (batch × samples, width), by the second layer's weights,
(width, width), once per iteration and in the same data type; and in float32 the first layer's parts for states (once)
and actions, and the last layer. Operands lie ready and no activation is applied. For the hidden ones the fastest of
PyTorch's kernels counts, in one piece and in blocks of several sizes; "of hidden" is their share alone. GFLOP/s counts the
same products."""


def sizes_to_measure(varied: Sequence[str]) -> list[Sizes]:
    """
    Vary one size at a time around the default.

    :param varied: the sizes to vary
    :return: the default, then the others, each once
    """
    variations = [replace(Sizes(), **{name: value}) for name in varied for value in VARIATIONS[name]]
    return list(dict.fromkeys([Sizes(), *variations]))


def cem_call(sizes: Sizes, make_score: Callable[[nn.Module, th.Tensor], Score], device: th.device) -> Callable[[], object]:
    """
    Make a CEM call on a random critic, as a gradient step makes it.

    :param sizes: the call's sizes
    :param make_score: makes the scoring function of a Q-network and of the states' features
    :param device: where to compute
    :return: the function to time
    """
    q_network = nn.Sequential(*create_mlp(sizes.n_features + sizes.action_dim, 1, [sizes.width] * 2)).to(device)
    features = th.randn(sizes.batch, sizes.n_features, device=device)
    cem = CEM(iterations=sizes.iterations, samples=sizes.samples)

    @th.no_grad()
    def run() -> None:
        cem.select(make_score(q_network, features), sizes.batch, sizes.action_dim, device)

    return run


def measure(args: argparse.Namespace) -> list[dict[str, Any]]:
    """
    Measure all the calls asked for.

    :param args: the command line
    :return: the figures, one entry for each combination of sizes and data type
    """
    th.manual_seed(args.seed)
    all_sizes = sizes_to_measure(args.vary)
    runs: dict[tuple[Sizes, str, str], Callable[[], object]] = {}
    for sizes in all_sizes:
        runs[sizes, "plain", ""] = cem_call(sizes, repeated_q_score, args.device)
        runs[sizes, "outer", ""] = outer_products(sizes, args.device)
        for dtype in args.dtypes:
            runs[sizes, dtype, "call"] = cem_call(sizes, partial(q_score, dtype=DTYPES[dtype]), args.device)
            for way, product in bare_products(sizes, DTYPES[dtype], args.device).items():
                runs[sizes, dtype, way] = product
    seconds = interleaved(runs, args.rounds, device=args.device, title="selector")
    return [
        figures(
            sizes,
            dtype,
            seconds[sizes, dtype, "call"],
            seconds[sizes, "plain", ""],
            seconds[sizes, "outer", ""],
            {key[2]: times for key, times in seconds.items() if key[:2] == (sizes, dtype) and key[2] != "call"},
        )
        for sizes in all_sizes
        for dtype in args.dtypes
    ]


def figures(
    sizes: Sizes, dtype: str, call: list[float], plain: list[float], outer: list[float], products: dict[str, list[float]]
) -> dict[str, Any]:
    """
    Put together what is known of one call.

    :param sizes: the call's sizes
    :param dtype: the data type of the hidden layers
    :param call: its seconds, by round
    :param plain: the plain way's
    :param outer: those of the products of the first and the last layer
    :param products: the bare products', by way
    :return: seconds, speeds and ratios
    """
    summaries = {way: summary(times) for way, times in products.items()}
    floor = min(summaries, key=lambda way: summaries[way]["median"])
    call_summary, flops = summary(call), call_flops(sizes)
    return {
        "sizes": asdict(sizes),
        "dtype": dtype,
        "call_seconds": call_summary,
        "plain_seconds": summary(plain),
        "ratio_to_plain": ratio(call, plain),
        "call_flops": flops,
        "flops_per_second": flops / call_summary["median"],
        "product_flops": product_flops(sizes),
        "product_seconds": summaries,
        "fastest_product": floor,
        "product_flops_per_second": product_flops(sizes) / summaries[floor]["median"],
        "outer_product_seconds": summary(outer),
        "share_of_products": ratio([first + second for first, second in zip(products[floor], outer, strict=True)], call),
        "share_of_hidden_products": ratio(products[floor], call),
    }


def markdown(record: dict[str, Any]) -> str:
    """
    Write the table.

    :param record: what was measured, and how
    :return: the table and its notes, in Markdown
    """
    header = [
        "batch × samples × iterations",
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


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """
    Read the command line.

    :param argv: the arguments
    :return: what they say
    """
    parser = measuring_parser("selector", "Measure one CEM call across its sizes and data types.")
    parser.add_argument("--rounds", type=count, default=20, help="timed calls of each kind (default: %(default)s)")
    parser.add_argument(
        "--dtypes", nargs="+", choices=list(DTYPES), default=list(DTYPES), help="hidden layers' data types (default: both)"
    )
    parser.add_argument(
        "--vary", nargs="*", choices=list(VARIATIONS), default=list(VARIATIONS), help="sizes to vary (default: all)"
    )
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
        **conditions("benchmark.selector", argv, args.device),
        "seed": args.seed,
        "rounds": args.rounds,
        "calls": measure(args),
    }
    publish(args.folder, "selector", record, markdown(record))


if __name__ == "__main__":
    main()
