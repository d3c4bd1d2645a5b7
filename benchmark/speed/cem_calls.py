"""The time of one CEM call, beside the same call with repeated observations and beside bare matrix products."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from benchmark.speed.products import LIGHT, Sizes, bare_products, call_flops, first_and_last_layer_products, product_flops
from benchmark.speed.timing import interleaved, ratio, summary
from sb3_cgp.core.cem import CEM, Score
from sb3_cgp.core.policies import repeated_q_score
from sb3_cgp.fast.scoring import q_score
from sb3_cgp.selectors import ActorCEM

DTYPES = {"float32": th.float32, "bfloat16": th.bfloat16}
VARIATIONS: dict[str, tuple[Any, ...]] = {
    "batch": (1, 32, 128, 256, 512),
    "samples": (16, 32, 64, 128, 256),
    "iterations": (1, 2, 4, 8),
    "action_dim": (1, 3, 6, 17),
    "width": (64, 128, 256, 512, 1024),
}


def sizes_to_measure(varied: Sequence[str]) -> list[Sizes]:
    """
    Return the sizes to measure: one is varied at a time around the default.

    :param varied: the sizes to vary
    :return: the default, that of CGP-Light, then the others, each once
    """
    variations = [replace(Sizes(), **{name: value}) for name in varied for value in VARIATIONS[name]]
    return list(dict.fromkeys([Sizes(), LIGHT, *variations]))


def cem_call(sizes: Sizes, make_score: Callable[[nn.Module, th.Tensor], Score], device: th.device) -> Callable[[], object]:
    """
    Return a function that makes a CEM call on a random critic, as a gradient step does.

    :param sizes: the call's sizes
    :param make_score: returns the scoring function of a Q-network and of the states' features
    :param device: device of the networks
    :return: the function to time
    """
    q_network = nn.Sequential(*create_mlp(sizes.n_features + sizes.action_dim, 1, [sizes.width] * 2)).to(device)
    features = th.randn(sizes.batch, sizes.n_features, device=device)
    proposals = th.rand(sizes.batch, 1, sizes.action_dim, device=device) * 2 - 1
    kind, given = (ActorCEM, {"proposals": proposals}) if sizes.start == "actor" else (CEM, {})
    cem = kind(iterations=sizes.iterations, samples=sizes.samples)

    @th.no_grad()
    def run() -> None:
        cem.select(make_score(q_network, features), sizes.batch, sizes.action_dim, device, **given)

    return run


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """
    Measure the calls that the command line asks for.

    :param args: the command line
    :return: under "calls", the figures of each combination of sizes and data type
    """
    th.manual_seed(args.seed)
    all_sizes = sizes_to_measure(args.vary)
    runs: dict[tuple[Sizes, str, str], Callable[[], object]] = {}
    for sizes in all_sizes:
        runs[sizes, "plain", ""] = cem_call(sizes, repeated_q_score, args.device)
        runs[sizes, "outer", ""] = first_and_last_layer_products(sizes, args.device)
        for dtype in args.dtypes:
            runs[sizes, dtype, "call"] = cem_call(sizes, partial(q_score, dtype=DTYPES[dtype]), args.device)
            for way, product in bare_products(sizes, DTYPES[dtype], args.device).items():
                runs[sizes, dtype, way] = product
    seconds = interleaved(runs, args.rounds, device=args.device, title="selector")
    calls = [
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
    return {"calls": calls}


def figures(
    sizes: Sizes, dtype: str, call: list[float], plain: list[float], outer: list[float], products: dict[str, list[float]]
) -> dict[str, Any]:
    """
    Summarise the measurements of one call.

    :param sizes: the call's sizes
    :param dtype: the data type of the hidden layers
    :param call: its seconds, by round
    :param plain: the seconds of the call with repeated observations
    :param outer: the seconds of the products of the first and the last layer
    :param products: the seconds of the bare products, by kernel and block
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
