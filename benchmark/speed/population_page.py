"""The page on the speed of a population."""

from typing import Any

from benchmark.common.provenance import conditions_in_words
from benchmark.common.tables import markdown_table
from benchmark.speed.card_estimates import GRAPH, NO_GRAPH
from benchmark.speed.population_points import ALONE

NOTES = """\
Steps of all agents together per second of `learn`, with a gradient step of each agent per step: median (quartiles) of
{rounds} rounds of {steps} steps in {env}, in {processes} processes at most. "alone" is an ordinary model, SB3's own for TD3;
"/ alone" the ratio to it. A step's milliseconds: "simulators" is the time in which the environments step; "products" that of
the step's matrix products alone (the selection of actions included), timed in a row, on a GPU in a CUDA graph; "rest" is what
remains. "of the device" is the operations of the products per second of the step, as a share of the device's rate of large
products in float32, {rate:.3g} TFLOP/s here. Memory is the largest that was allocated on a GPU, or this process's resident
memory without one."""
ESTIMATE = """\
## Estimate for a GPU, not measured

**None of these figures was measured.** They are for HalfCheetah-v5, also where another environment was measured. The operators
of a gradient step, and the operations of its products, are counted from the population's code. They are turned into seconds by
the rates of the {name} ({source}: {tflops:.0f} TFLOP/s in float32
without tensor cores, {bandwidth:.2f} TB/s), which are upper bounds of what programs reach, and by the costs of launches that
follow from recorded times of one agent on that card (`benchmark/results/runtime_gpu`): {graph:.1f} us for an operator within
a CUDA graph, {host:.0f} us for one that the CPU launches on its own, {rest:.2f} ms of other work on the CPU, which is taken
to be the same for all numbers of agents. A simulator's step is taken as {simulator:.0f} us (`benchmark/results/runtime`,
random actions) on each of {cores} cores; messages between processes are left out. "/ one" is the ratio to one agent's
estimate; "of the card" the operations of the products per second of the step, as a share of the card's rate."""


def markdown(record: dict[str, Any]) -> str:
    """
    Write the page.

    :param record: measurements, estimates and their conditions
    :return: tables and notes, in Markdown
    """
    parts = ["# Population"]
    if record["points"]:
        rate = record["product_rate"]["flops_per_second"] / 1e12
        names = ("env", "rounds", "steps", "processes")
        parts += [_measured_table(record), NOTES.format(rate=rate, **{name: record[name] for name in names})]
    if record.get("estimates"):
        parts += _estimate(record["estimates"])
    return "\n\n".join([*parts, conditions_in_words(record)]) + "\n"


def _measured_table(record: dict[str, Any]) -> str:
    header = [
        "method",
        "agents",
        "agent-steps/s",
        "/ alone",
        "step, ms",
        "simulators",
        "products",
        "rest",
        "of the device",
        "MB",
    ]
    points = record["points"]
    alone = {point["method"]: point["agent_steps_per_second"]["median"] for point in points if point["n_agents"] == ALONE}
    rate = record["product_rate"]["flops_per_second"]
    # By method, as they were measured in the order of their value
    methods = list(dict.fromkeys(point["method"] for point in points))
    in_order = sorted(points, key=lambda point: (methods.index(point["method"]), point["n_agents"]))
    return markdown_table(header, [_row(point, alone.get(point["method"]), rate) for point in in_order])


def _row(point: dict[str, Any], alone: float | None, rate: float) -> list[str]:
    speed, step = point["agent_steps_per_second"], point["step_seconds"]["median"]
    simulators = point["simulator_seconds"]["median"]
    parts = ["-", "-", "-"]
    if "product_seconds" in point:
        products = point["product_seconds"]["median"]
        rest = step - simulators - products
        parts = [f"{1e3 * products:.2f}", f"{1e3 * rest:.2f}", f"{point['flops'] / step / rate:.1%}"]
    memory = point["memory_bytes"]
    return [
        point["method"],
        "alone" if point["n_agents"] == ALONE else str(point["n_agents"]),
        f"{speed['median']:,.0f} ({speed['lower']:,.0f}-{speed['upper']:,.0f})",
        "-" if alone is None else f"{speed['median'] / alone:.2f}",
        f"{1e3 * step:.2f}",
        f"{1e3 * simulators:.2f}",
        *parts,
        "-" if memory is None else f"{memory / 1e6:,.0f}",
    ]


def _estimate(estimates: dict[str, Any]) -> list[str]:
    card, costs = estimates["card"], estimates["costs"]
    notes = ESTIMATE.format(
        name=card["name"],
        source=card["source"],
        tflops=card["flops_per_second"] / 1e12,
        bandwidth=card["bytes_per_second"] / 1e12,
        cores=card["cores"],
        graph=1e6 * costs["graph_launch"],
        host=1e6 * costs["host_launch"],
        rest=1e3 * costs["host_rest"],
        simulator=1e6 * costs["simulator"],
    )
    header = [
        *("method", "agents", "operators", "GFLOP", "agent-steps/s, graph", "/ one", "agent-steps/s, no graph", "/ one"),
        "step with graph, ms",
        "of the card",
    ]
    one = {point["method"]: point["agent_steps_per_second"] for point in estimates["points"] if point["n_agents"] == 1}
    rows = []
    for point in estimates["points"]:
        speeds = point["agent_steps_per_second"]
        reference = one.get(point["method"])
        cells = [
            cell
            for mode in (GRAPH, NO_GRAPH)
            for cell in (f"{speeds[mode]:,.0f}", "-" if reference is None else f"{speeds[mode] / reference[mode]:.1f}")
        ]
        counts = point["counts"]
        rows.append(
            [
                *(
                    point["method"],
                    str(point["n_agents"]),
                    f"{counts['operators']:.0f}",
                    f"{counts['flops'] / 1e9:.2f}",
                    *cells,
                ),
                f"{1e3 * point['n_agents'] / speeds[GRAPH]:.2f}",
                f"{point['share_of_product_rate']:.0%}",
            ]
        )
    return [notes, markdown_table(header, rows)]
