"""The measurements of populations: what is counted, what estimates follow from, and what is kept. Times are not tested."""

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from matplotlib.image import imread
from stable_baselines3.common.env_util import make_vec_env
from tables import unpadded
from torch.utils.flop_counter import FlopCounterMode

from benchmark import environments_in_step, population
from benchmark.speed import card_estimates, environment_steps, population_points
from benchmark.speed.card_estimates import GRAPH, H100, NO_GRAPH, Costs, estimate, work_seconds
from benchmark.speed.environment_ways import WAYS, GymnasiumVecEnv
from benchmark.speed.operations import Operation, bare_products, record_operations, total_flops
from benchmark.speed.population_counts import StepOperations, count_step
from benchmark.speed.population_methods import make_box, make_population
from benchmark.speed.population_points import ALONE, points_in_order
from sb3_cgp.population.gradient_step import GradientStep

CPU = th.device("cpu")
ROOT = Path(__file__).parent.parent
B, F, A, H = 128, 17, 6, 256


def test_operators_are_recorded_with_their_products_and_bytes_and_views_are_not():
    weight, inputs = th.randn(4, 5, requires_grad=True), th.randn(3, 4)
    operations = record_operations(lambda: (inputs @ weight).relu().view(15).sum().backward())
    # Forward, and the gradient of the weight; the inputs have none
    products = [operation for operation in operations if operation.flops > 0]
    assert [operation.flops for operation in products] == [2 * 3 * 4 * 5] * 2
    assert products[0].n_bytes == 4 * (12 + 20 + 15)
    assert products[0].shapes == ((3, 4), (4, 5))
    names = [operation.name for operation in operations]
    assert {"mm", "relu", "sum", "threshold_backward"} <= set(names)
    assert not {"view", "t", "expand", "detach"} & set(names)


def test_bare_products_are_the_recorded_ones(monkeypatch):
    left, right = th.randn(2, 3, 4), th.randn(2, 4, 5)
    operations = record_operations(lambda: th.baddbmm(th.zeros(2, 1, 5), left, right).relu() + th.bmm(left, right))
    run = bare_products(operations, CPU)
    with FlopCounterMode(display=False) as counter:
        run()
    assert counter.get_total_flops() == total_flops(operations) == 2 * 2 * 2 * 3 * 4 * 5


def closed_form(method, n_agents):
    """Operations of a mean gradient step: of forward passes 2 B per weight, of backward passes 4 B less the inputs' part."""
    critic, actor = (F + A) * H + H * H + H, F * H + H * H + H * A
    # Two critics: their targets, their values, and their gradients without those of the inputs
    critics = 2 * B * 2 * critic * 2 + 2 * B * 2 * (2 * critic - (F + A) * H)
    # The actor forward and backward
    actors = 2 * B * actor + 2 * B * (2 * actor - F * H)
    # A search by the first critic, with the states' part once
    searched = {"CGP-2": 2 * 64, "CGP-Light": 16, "TD3": 0}[method]
    search = 2 * B * F * H * (searched > 0) + 2 * B * searched * (A * H + H * H + H)
    if method == "CGP-2":
        return n_agents * (critics + 2 * search + actors)
    if method == "CGP-Light":
        # Two proposals, of the actor and of its average
        return n_agents * (critics + 2 * search + actors + 2 * 2 * B * actor)
    return None


@pytest.mark.parametrize("method", ["CGP-2", "CGP-Light"])
@pytest.mark.parametrize("n_agents", [1, 3])
def test_products_agree_with_a_count_by_hand(method, n_agents):
    assert count_step(method, n_agents).per_gradient_step()["flops"] == closed_form(method, n_agents)


@pytest.mark.parametrize("method", ["CGP-Light", "TD3"])
def test_what_is_counted_without_values_is_what_a_training_computes(method, monkeypatch):
    """The products of real gradient steps, by PyTorch's own counter, and their operators."""
    counted, steps = count_step(method, 1), []

    def count(self, *inputs):
        with FlopCounterMode(display=False) as counter:
            operations = record_operations(lambda: call(self, *inputs))
        steps.append((counter.get_total_flops(), [operation.name for operation in operations]))
        return None, None, None

    call = GradientStep.__call__
    monkeypatch.setattr(GradientStep, "__call__", count)
    model = make_population(method, make_box(), CPU, learning_starts=2, buffer_size=8)
    monkeypatch.setattr(model, "_report_failures", lambda: None)
    model.learn(2 + len(counted.gradient_steps))
    assert [flops for flops, _ in steps] == [total_flops(each) for each in counted.gradient_steps]
    assert [names for _, names in steps] == [[each.name for each in step] for step in counted.gradient_steps]


def test_launches_do_not_grow_with_agents_and_products_grow_in_proportion():
    few, many = (count_step("TD3", n_agents).per_gradient_step() for n_agents in (2, 6))
    assert many["operators"] == few["operators"] > 100
    assert many["flops"] == 3 * few["flops"]
    # Learning rates and counters are each agent's own, too
    assert many["bytes"] == pytest.approx(3 * few["bytes"], rel=0.01)


def test_an_estimate_follows_from_the_counts_and_the_costs():
    card = card_estimates.Card("card", flops_per_second=1e6, bytes_per_second=1e3, source="", cores=4)
    product, other = Operation("bmm", flops=4_000_000, n_bytes=1_000), Operation("add", flops=0, n_bytes=2_000)
    assert work_seconds([product, other], card) == 4.0 + 2.0
    # A cycle of two steps: a mean of 1.5 operators and 5 seconds of work
    step = StepOperations([[product], [product, other]], acting=[other])
    costs = Costs(graph_launch=0.1, host_launch=8.0, host_rest=0.5, simulator=0.25)
    found = estimate(step, n_agents=6, card=card, costs=costs)
    # Six environments on four cores take two steps' time
    host = 2 * 0.25 + 0.5
    graph = host + (8.0 + 0.1 + 2.0) + (8.0 + 0.15 + 5.0)
    assert found["agent_steps_per_second"][GRAPH] == pytest.approx(6 / graph)
    assert found["agent_steps_per_second"][NO_GRAPH] == pytest.approx(6 / (host + 8.0 + 12.0))
    assert found["share_of_product_rate"] == pytest.approx(4_000_000 / graph / 1e6)


def test_the_costs_give_back_the_recorded_times_of_one_agent():
    """CGP-2's and CGP-4's recorded times determine the cost of a launch and the rest on the host."""
    costs = card_estimates.derive_costs(H100)
    methods = json.loads(card_estimates.GPU_RECORD.read_text())["methods"]
    for name in ("CGP-2", "CGP-4"):
        step = count_step(name, 1)
        n_steps = len(step.gradient_steps)
        operations = [operation for each in step.gradient_steps for operation in each]
        n_operators = len(operations) / n_steps + len(step.acting)
        work = work_seconds(operations, H100) / n_steps + work_seconds(step.acting, H100)
        seconds = costs.simulator + costs.host_rest + costs.graph_launch * n_operators + work
        assert 1000 * seconds == pytest.approx(methods[name]["train"]["seconds"]["median"])
    assert 1e-6 < costs.graph_launch < costs.host_launch < 1e-4


def test_points_of_value_come_first():
    points = list(points_in_order(["a", "b"], [1, 4, 8, 16, 32, 64]))
    assert [number for method, number in points if method == "a"] == [ALONE, 1, 32, 8, 64, 4, 16]
    assert points[:4] == [("a", ALONE), ("b", ALONE), ("a", 1), ("b", 1)]
    assert len(set(points)) == len(points) == 14


TINY = "--device cpu --env Pendulum-v1 --numbers 1 2 --methods TD3 --rounds 2 --steps 2 --processes 1"


@pytest.fixture
def small(monkeypatch):
    """Few random steps, and a small product for the device's rate."""
    monkeypatch.setattr(population_points, "WARM_UP", 4)
    monkeypatch.setattr(population_points, "BURN_IN", 2)
    monkeypatch.setattr(population, "measure_product_rate", lambda device: {"flops_per_second": 1e9, "size": 1})
    monkeypatch.setattr(population, "estimate_all", lambda methods, numbers: card_estimates_of(methods, numbers))


def card_estimates_of(methods, numbers):
    """Estimates of populations of small costs, without the records."""
    costs = Costs(1e-6, 1e-5, 1e-4, 1e-5)
    step = StepOperations([[Operation("bmm", 10**9, 10**6)]], [Operation("add", 0, 10)])
    points = [
        {"method": method, "n_agents": number, "counts": step.per_gradient_step() | {"acting_operators": 1}}
        | estimate(step, number, H100, costs)
        for method in methods
        for number in numbers
    ]
    return {"card": vars(H100), "costs": vars(costs), "points": points}


def test_the_command_writes_what_it_measures_and_marks_what_it_estimates(tmp_path, small):
    population.main([*TINY.split(), "--folder", str(tmp_path)])
    record = json.loads((tmp_path / "population.json").read_text())
    assert [(point["method"], point["n_agents"]) for point in record["points"]] == [("TD3", 0), ("TD3", 1), ("TD3", 2)]
    for point in record["points"]:
        steps, speeds = point["step_seconds"]["all"], point["agent_steps_per_second"]["all"]
        assert speeds == pytest.approx([max(point["n_agents"], 1) / each for each in steps])
        assert 0 < point["simulator_seconds"]["median"] < point["step_seconds"]["median"]
    # Pendulum's dimensions, not HalfCheetah's
    assert record["points"][2]["flops"] == 2 * record["points"][1]["flops"]
    step = count_step("TD3", 1, (3, 1))
    assert record["points"][1]["flops"] == step.per_gradient_step()["flops"] + total_flops(step.acting)
    page = unpadded((tmp_path / "population.md").read_text())
    speed = record["points"][2]["agent_steps_per_second"]["median"]
    assert f"| TD3 | 2 | {speed:,.0f} (" in page
    assert "## Estimate for a GPU, not measured\n\n**None of these figures was measured.**" in page
    # Of HalfCheetah's dimensions, not Pendulum's
    assert "They are for HalfCheetah-v5" in page
    picture = imread(tmp_path / "population.png", format="png")
    assert picture[..., :3].std() > 0.01, "the picture is blank"


def test_points_that_are_there_are_kept_and_a_time_limit_ends_between_points(tmp_path, small, monkeypatch):
    measured = []

    def measure_point(method, n_agents, args):
        measured.append(n_agents)
        figures = {"median": 1.0, "lower": 1.0, "upper": 1.0, "all": [1.0]}
        names = ("agent_steps_per_second", "step_seconds", "simulator_seconds", "gradient_step_seconds")
        return {"method": method, "n_agents": n_agents, "memory_bytes": None, **dict.fromkeys(names, figures)}

    monkeypatch.setattr(population, "measure_point", measure_point)
    clock = iter([0.0, 30.0, 50.0, 70.0, *[0.0] * 9])
    monkeypatch.setattr(population.time, "monotonic", lambda: next(clock))
    options = [*TINY.split(), "--folder", str(tmp_path), "--minutes", "1"]
    with pytest.raises(SystemExit) as end:
        population.main(options)
    assert end.value.code == population.TIME_OVER
    assert measured == [0, 1]
    population.main(options)
    assert measured == [0, 1, 2]
    with pytest.raises(SystemExit, match="another --folder"):
        population.main([*options, "--seed", "5"])


def test_a_damaged_record_is_named(tmp_path):
    path = tmp_path / "population.json"
    path.write_text("{}")
    with pytest.raises(SystemExit, match=rf"^Error: {path} lacks points, machine, .*Move it away"):
        population.main([*TINY.split(), "--folder", str(tmp_path)])


def test_estimates_and_measurements_of_separate_calls_are_kept(tmp_path, small):
    """With and without estimates, in both orders."""
    options = [*TINY.split(), "--folder", str(tmp_path)]

    def found(*further):
        population.main([*options, *further])
        record = json.loads((tmp_path / "population.json").read_text())
        page = (tmp_path / "population.md").read_text()
        return len(record["points"]), len(record["estimates"]["points"]), "/ alone" in page, "not measured" in page

    assert found("--only-estimate") == (0, 2, False, True)
    assert found("--no-estimate") == (3, 2, True, True)
    assert found("--only-estimate") == (3, 2, True, True)
    assert json.loads((tmp_path / "population.json").read_text())["product_rate"] == {"flops_per_second": 1e9, "size": 1}


@pytest.mark.parametrize(("options", "is_estimated"), [([], False), (["--estimate"], True), (["--only-estimate"], True)])
def test_with_a_gpu_estimates_are_made_where_they_are_asked_for(options, is_estimated, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmark.common.measuring.device", th.device)
    args = population.parse(["--device", "cuda", "--folder", str(tmp_path), *options])
    assert args.estimate == is_estimated


def test_without_the_packages_of_page_and_figure_the_record_is_written(tmp_path, small, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "benchmark.speed.population_page", None)
    population.main([*TINY.split(), "--only-estimate", "--folder", str(tmp_path)])
    assert json.loads((tmp_path / "population.json").read_text())["estimates"]["points"]
    assert not (tmp_path / "population.md").exists()
    assert "not written" in capsys.readouterr().out


def test_a_bare_machine_has_enough_for_the_command_and_the_list(tmp_path):
    """Without rl_zoo3, Optuna, and what else the extras bring."""
    missing = ["rl_zoo3", "optuna", "pytablewriter", "matplotlib", "pandas", "rliable", "scipy", "tensorboard"]
    missing += ["sb3_contrib", "onnx", "psutil"]
    (tmp_path / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({missing!r}))\n")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}

    def run(*command):
        return subprocess.run([sys.executable, "-m", *command], cwd=ROOT, env=environment, capture_output=True, text=True)

    options = "--device cpu --only-estimate --methods TD3 --numbers 1 --folder"
    result = run("benchmark.population", *options.split(), str(tmp_path))
    assert result.returncode == 0, result.stderr
    assert "pytablewriter" in result.stdout
    assert json.loads((tmp_path / "population.json").read_text())["estimates"]["points"]
    result = run("benchmark.gpu_list", "--list", "--folder", str(tmp_path))
    assert result.returncode == 0, result.stderr
    # The other commands say what they need
    assert "needs rl_zoo3" in run("benchmark.runtime", "--help").stderr


def test_ways_of_stepping_are_measured_in_turn_and_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(environment_steps, "preload", lambda: None)
    monkeypatch.setitem(sys.modules, "envpool", None)
    options = "--env Pendulum-v1 --numbers 2 --ways dummy chunked envpool --processes 1 --rounds 2 --steps 3"
    environments_in_step.main([*options.split(), "--folder", str(tmp_path)])
    record = json.loads((tmp_path / "environments_in_step.json").read_text())
    points = {point["way"]: point for point in record["points"]}
    assert points["envpool"]["missing"].startswith("not measured: ")
    for name in ("dummy", "chunked"):
        assert len(points[name]["steps_per_second"]["all"]) == 2
        assert points[name]["ratio"] is None
    text = unpadded((tmp_path / "environments_in_step.md").read_text())
    assert f"| 2 | {WAYS['chunked'].title} | " in text


def test_gymnasiums_environments_end_episodes_as_sb3s_do():
    """In this process: the adapter is what is tested."""

    env = SyncVectorEnv([lambda: gym.make("Pendulum-v1", max_episode_steps=3)] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    ours = GymnasiumVecEnv(env, 2, (env.single_observation_space, env.single_action_space), seed=4)
    theirs = make_vec_env("Pendulum-v1", 2, 4, env_kwargs=dict(max_episode_steps=3))
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for number in range(7):
        actions = np.full((2, 1), 0.3 * number, np.float32)
        (observations, rewards, dones, infos), (*expected, their_infos) = ours.step(actions), theirs.step(actions)
        np.testing.assert_array_equal(observations, expected[0])
        np.testing.assert_allclose(rewards, expected[1], rtol=1e-6)
        np.testing.assert_array_equal(dones, expected[2])
        for info, other in zip(infos, their_infos, strict=True):
            assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            assert ("terminal_observation" in info) == ("terminal_observation" in other)
            if "terminal_observation" in info:
                np.testing.assert_array_equal(info["terminal_observation"], other["terminal_observation"])
