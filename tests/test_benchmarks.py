"""The measuring commands: what they time, what they count, and what they write. Times themselves are not tested."""

import json
import re
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.utils.env_checker import check_env
from matplotlib.image import imread
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from tables import unpadded
from torch import nn

from benchmark import checkpoint, latency, runtime, scaling, selector
from benchmark.common import arguments
from benchmark.speed import cem_calls, checkpoints, contenders, latencies, products, run_times, scaling_points
from benchmark.speed.boxes import BoxEnv
from benchmark.speed.products import Sizes
from benchmark.speed.timing import interleaved, ratio, summary, timed
from sb3_cgp import CGP
from sb3_cgp.core.policies import CGPPolicy as PlainPolicy
from sb3_cgp.core.policies import repeated_q_score

CPU = th.device("cpu")
COMMANDS = {"checkpoint": checkpoint, "latency": latency, "runtime": runtime, "selector": selector, "scaling": scaling}


def test_turns_rotate_and_the_burn_in_is_not_timed():
    calls = []
    runs = {name: lambda name=name: calls.append(name) for name in "abc"}
    seconds = interleaved(runs, rounds=3, burn_in=1)
    assert "".join(calls) == "abc" + "bca" + "cab" + "abc"
    assert {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3, "c": 3}


def test_seconds_are_those_of_the_call_and_in_the_order_of_the_rounds(monkeypatch):
    clock, durations = [0.0], iter([9.0, 9.0, 1.0, 20.0, 40.0, 2.0])

    def run():
        clock[0] += next(durations)

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    # Rounds: a b (burn-in), b a, a b
    assert interleaved({"a": run, "b": run}, rounds=2) == {"a": [20.0, 40.0], "b": [1.0, 2.0]}
    assert timed(lambda: None) == 0.0


def test_nothing_to_time_is_no_error():
    assert interleaved({}, rounds=2) == {}


def test_ratio_is_within_rounds():
    # A slow first round hits both alike; the ratio of the medians would be 1.5
    assert ratio([100.0, 2.0, 3.0], [50.0, 1.0, 2.0]) == 2.0
    assert summary([4.0, 1.0, 2.0, 3.0, 5.0]) == {"median": 3.0, "lower": 2.0, "upper": 4.0, "all": [4.0, 1.0, 2.0, 3.0, 5.0]}


def test_operations_agree_with_a_count_by_hand():
    sizes = Sizes(batch=3, samples=5, iterations=2, action_dim=2, width=4, n_features=7)
    # Once per state 7 x 4, for each of 2 x 15 actions 2 x 4 + 4 x 4 + 4 x 1; a multiplication and an addition each
    assert products.call_flops(sizes) == 2 * (3 * 28 + 30 * 28)
    assert products.product_flops(sizes) == 2 * 30 * 16
    # The two big products of the default call
    assert products.product_flops(Sizes()) == 2 * 2 * 8192 * 256 * 256


@pytest.mark.parametrize("batch", [100, 6000])
def test_bare_products_do_the_operations_that_are_counted(monkeypatch, batch):
    sizes = Sizes(batch=batch, samples=1, iterations=3, width=4)
    counted = []

    def multiply(left, weight, result):
        assert (left.dtype, weight.dtype) == (th.bfloat16, th.bfloat16)
        assert weight.shape == (4, 4)
        counted.append(2 * left.shape[0] * left.shape[1] * weight.shape[0])

    monkeypatch.setattr(products, "kernels", lambda device: {"kernel": multiply})
    ways = products.bare_products(sizes, th.bfloat16, CPU)
    assert len(ways) == (1 if batch == 100 else 4)
    for run in ways.values():
        counted.clear()
        run()
        assert sum(counted) == products.product_flops(sizes)


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_every_kernel_multiplies_by_the_transposed_weights(dtype):
    left, weight, result = th.randn(5, 8).to(dtype), th.randn(8, 8).to(dtype), th.empty(5, 8, dtype=dtype)
    for name, multiply in products.kernels(CPU).items():
        product = multiply(left, weight, result)
        th.testing.assert_close(product.float(), left.float() @ weight.float().t(), rtol=1e-2, atol=1e-1, msg=name)


def test_sizes_are_varied_one_at_a_time():
    sizes = cem_calls.sizes_to_measure(["batch", "width"])
    assert sizes[0] == Sizes()
    assert len(set(sizes)) == len(sizes) == 1 + 4 + 4
    assert {(size.batch, size.width) for size in sizes} == {
        *((batch, 256) for batch in (1, 32, 128, 256, 512)),
        *((128, width) for width in (64, 128, 256, 512, 1024)),
    }


def test_plain_policy_selects_what_the_fast_one_selects():
    env = make_vec_env("Pendulum-v1", seed=0)
    fast, plain = (CGP(policy, env, buffer_size=10, seed=0) for policy in ("MlpPolicy", PlainPolicy))
    plain.set_parameters(fast.get_parameters())
    fast.policy.cem_dtype = "float32"
    observations = th.randn(20, 3)
    selections = []
    for model in (fast, plain):
        th.manual_seed(7)
        selections.append(model.policy.select_actions(observations, model.critic))
    th.testing.assert_close(selections[0].actions, selections[1].actions, rtol=1e-4, atol=1e-4)
    th.testing.assert_close(selections[0].std, selections[1].std, rtol=1e-4, atol=1e-4)


def test_plain_policy_repeats_every_observation():
    model = CGP(PlainPolicy, make_vec_env("Pendulum-v1"), buffer_size=10, cem_samples=8, cem_iterations=3)
    # By PyTorch's modules alone
    assert all(type(network) is nn.Sequential for network in (model.actor.mu, *model.critic.q_networks))
    rows = []
    first = model.critic.q_networks[0][0]
    first.register_forward_hook(lambda layer, inputs, output: rows.append(inputs[0].shape))
    model.policy.select_actions(th.randn(5, 3), model.critic)
    assert rows == [(5 * 8, 3 + 1)] * 3


def run_command(name: str, folder: Path, *options: str) -> dict:
    """Run a command, and read the record that it writes."""
    COMMANDS[name].main([*options, "--folder", str(folder)])
    assert not list(folder.glob(".*")), "an unfinished file was left behind"
    return json.loads((folder / f"{name}.json").read_text())


@pytest.fixture(scope="module")
def runtime_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run-time table of a few methods, without SBX, on episodes of a few steps."""
    th.set_num_threads(1)
    folder = tmp_path_factory.mktemp("runtime")
    options = "--env Pendulum-v1 --episode-steps 6 --episodes 3 --inference-episodes 4 --seed 5"
    with pytest.MonkeyPatch.context() as patch:
        # What Python puts there for a module that shall not be found
        patch.setitem(sys.modules, "sbx", None)
        methods = ["Random", "SAC", "TD3", "CEM-2", "CGP-2", "CGP-2-plain", "SBX-TD3"]
        run_command("runtime", folder, *options.split(), "--methods", *methods)
    return folder


def test_runtime_ratios_follow_from_the_seconds(runtime_folder):
    methods = json.loads((runtime_folder / "runtime.json").read_text())["methods"]
    for phase, rounds in (("train", 3), ("inference", 4)):
        reference = methods["TD3"][phase]["seconds"]["all"]
        assert methods["TD3"][phase]["ratio"] == 1.0
        for name in ("SAC", "CEM-2", "CGP-2", "CGP-2-plain"):
            seconds = methods[name][phase]["seconds"]
            assert len(seconds["all"]) == rounds
            assert min(seconds["all"]) > 0.0
            assert seconds["median"] == pytest.approx(np.median(seconds["all"]))
            ratios = sorted(mine / td3 for mine, td3 in zip(seconds["all"], reference, strict=True))
            assert methods[name][phase]["ratio"] == pytest.approx((ratios[(rounds - 1) // 2] + ratios[rounds // 2]) / 2)


def test_timed_episodes_make_one_gradient_step_per_environment_step(runtime_folder):
    methods = json.loads((runtime_folder / "runtime.json").read_text())["methods"]
    for name in ("SAC", "TD3", "CEM-2", "CGP-2", "CGP-2-plain"):
        assert methods[name]["timed_gradient_steps"] == 3 * 6, name


def test_runtime_table_says_what_was_measured(runtime_folder):
    record = json.loads((runtime_folder / "runtime.json").read_text())
    text = (runtime_folder / "runtime.md").read_text()
    lines = [[cell.strip() for cell in line.split("|")] for line in text.splitlines() if line.startswith("|")]
    rows = {name: cells for _, name, *cells, _ in lines}
    assert rows["Random"][:3] == ["-", "-", "-"]
    assert rows["Random"][5] == "0.20"
    assert rows["TD3"][1:3] == ["1.00", "1.00"]
    assert rows["CGP-2"][1:3] == [f"{record['methods']['CGP-2']['train']['ratio']:.2f}", "1.95"]
    assert rows["CEM-2"][4:] == [f"{record['methods']['CEM-2']['inference']['ratio']:.2f}", "2.68"]
    assert rows["SBX-TD3"][0] == record["methods"]["SBX-TD3"]["missing"]
    assert re.match("not measured: .*sbx", rows["SBX-TD3"][0])
    assert "CGP-4" not in rows
    assert (record["env"], record["episode_steps"], record["seed"]) == ("Pendulum-v1", 6, 5)
    # Of PyPI's builds for CUDA, PyTorch alone names the local version
    assert record["versions"]["torch"] in (th.__version__, th.__version__.partition("+")[0])
    assert record["machine"]["torch_threads"] == 1
    assert record["command"].startswith("python -m benchmark.runtime --env Pendulum-v1 ")
    assert record["command"] in text


def test_without_td3_there_are_no_ratios(tmp_path):
    options = "--env Pendulum-v1 --episode-steps 2 --episodes 1 --inference-episodes 1 --methods DDPG"
    record = run_command("runtime", tmp_path, *options.split())
    assert record["methods"]["DDPG"]["train"]["ratio"] is None
    assert "| - | 1.01 |" in unpadded((tmp_path / "runtime.md").read_text())


def test_every_contender_has_the_same_batch_and_network():
    env = make_vec_env("Pendulum-v1")
    for name, contender in contenders.CONTENDERS.items():
        if contender.package in (None, "sbx"):
            continue
        model = contenders.make_agent(name, env, learning_starts=1, seed=0, device=CPU)
        widths = [layer.out_features for layer in model.actor.modules() if isinstance(layer, th.nn.Linear)]
        assert widths[:2] == [256, 256], name
        networks = getattr(model.critic, "quantile_critics", None) or model.critic.q_networks
        assert len(networks) == (1 if name == "DDPG" else 2), name
        for network in networks:
            widths = [layer.out_features for layer in network.modules() if isinstance(layer, th.nn.Linear)]
            assert widths[:-1] == [256, 256], name
        assert (model.batch_size, model.gradient_steps, model.train_freq.frequency) == (128, 1, 1), name
        if contender.algorithm == "CGP":
            sizes = (1, 16, "actor") if name == "CGP-Light" else (int(name[4]), 64, "prior")
            assert (model.cem_iterations, model.cem_samples, model.cem_start) == sizes, name
            assert model.policy.inference == ("cem" if name.startswith("CEM") else "actor"), name


def test_data_type_goes_to_the_methods_that_score_by_the_fast_way(tmp_path, monkeypatch):
    given = {}
    monkeypatch.setattr(run_times, "make_agent", lambda name, *args, **kwargs: given.update({name: kwargs}))
    methods = ["TD3", "CEM-4", "CGP-2", "CGP-2-plain"]
    options = f"--env Pendulum-v1 --cem-dtype float32 --folder {tmp_path}"
    args = runtime.parse([*options.split(), "--methods", *methods])
    run_times.make_agents(args)
    float32 = {"cem_dtype": "float32"}
    assert given == {"TD3": {}, "CEM-4": float32, "CGP-2": float32, "CGP-2-plain": {}}


def test_inference_acts_deterministically_for_as_many_steps_as_asked():
    asked = []

    class Agent(contenders.RandomAgent):
        def predict(self, observation, deterministic=False):
            asked.append((observation.copy(), deterministic))
            return super().predict(observation, deterministic)

    episode = run_times.inference_episode(Agent(make_vec_env("Pendulum-v1")), "Pendulum-v1", seed=0, steps=4)
    episode()
    episode()
    assert [deterministic for _, deterministic in asked] == [True] * 8
    # It goes on where it was, rather than from the same start
    assert len({observation.tobytes() for observation, _ in asked}) == 8


def test_selector_writes_what_follows_from_the_seconds(tmp_path):
    record = run_command("selector", tmp_path, "--rounds", "2", "--dtypes", "float32", "--vary")
    (entry,) = record["calls"]
    assert entry["sizes"] == {"batch": 128, "samples": 64, "iterations": 2, "action_dim": 6, "width": 256, "n_features": 17}
    call, plain = entry["call_seconds"]["all"], entry["plain_seconds"]["all"]
    assert len(call) == len(plain) == 2
    assert entry["ratio_to_plain"] == pytest.approx((call[0] / plain[0] + call[1] / plain[1]) / 2)
    assert entry["flops_per_second"] == pytest.approx(entry["call_flops"] / np.mean(call))
    medians = {way: product["median"] for way, product in entry["product_seconds"].items()}
    assert len(medians) == 4 * len(products.kernels(CPU))
    floor = entry["fastest_product"]
    assert medians[floor] == min(medians.values())
    fastest = entry["product_seconds"][floor]["all"]
    outer = entry["outer_product_seconds"]["all"]
    assert entry["share_of_hidden_products"] == pytest.approx((fastest[0] / call[0] + fastest[1] / call[1]) / 2)
    shares = [(fastest[turn] + outer[turn]) / call[turn] for turn in range(2)]
    assert entry["share_of_products"] == pytest.approx(sum(shares) / 2)
    row = next(line for line in unpadded((tmp_path / "selector.md").read_text()).splitlines() if "128 × 64 × 2" in line)
    assert f"| {entry['ratio_to_plain']:.2f} |" in row
    assert f"| {entry['share_of_products']:.0%} |" in row


def test_selector_asks_for_the_data_type(tmp_path, monkeypatch):
    asked = set()

    def score(network, features, dtype):
        asked.add(dtype)
        return repeated_q_score(network, features)

    monkeypatch.setattr(cem_calls, "q_score", score)
    run_command("selector", tmp_path, "--rounds", "1", "--dtypes", "bfloat16", "--vary")
    assert asked == {th.bfloat16}


@pytest.mark.parametrize("sizes", [Sizes(), Sizes(batch=5, samples=3, iterations=4, action_dim=2, width=8, n_features=7)])
def test_outer_and_hidden_products_are_all_that_a_call_multiplies(monkeypatch, sizes):
    counted = []

    def multiply(left, right, out):
        assert (left.dtype, out.shape) == (th.float32, (left.shape[0], right.shape[1]))
        counted.append(2 * left.shape[0] * left.shape[1] * right.shape[1])

    run = products.outer_products(sizes, CPU)
    monkeypatch.setattr(th, "mm", multiply)
    run()
    assert sum(counted) + products.product_flops(sizes) == products.call_flops(sizes)


def test_scaling_draws_what_it_measures(tmp_path, monkeypatch):
    monkeypatch.setattr(scaling_points, "AXES", {"cem_samples": (8, 16), "observation_dim": (3, 5), "n_envs": (1, 2)})
    options = "--env Pendulum-v1 --rounds 2 --gradient-steps 2 --axes cem_samples observation_dim n_envs"
    record = run_command("scaling", tmp_path, *options.split())
    points = record["points"]
    assert [(point["axis"], point["value"], point["algorithm"]) for point in points] == [
        (axis, value, algorithm)
        for axis, values in scaling_points.AXES.items()
        for value in values
        for algorithm in ("CGP", "TD3")
    ]
    for point in points:
        assert len(point["gradient_step_seconds"]["all"]) == 2
        assert ("env_steps_per_second" in point) == (point["axis"] == "n_envs")
    # TD3 has no samples: one measurement serves all along the axis
    assert points[1]["gradient_step_seconds"] == points[3]["gradient_step_seconds"]
    picture = imread(tmp_path / "scaling.png", format="png")
    assert picture.shape[1] > picture.shape[0] > 300
    assert picture[..., :3].std() > 0.01, "the picture is blank"


def test_scaling_divides_by_the_steps_that_are_made(tmp_path, monkeypatch):
    def one_second_each(runs, rounds, **_):
        for run in runs.values():
            model = run.func.__self__
            updates, timesteps = model._n_updates, model.num_timesteps
            run()
            assert model._n_updates - updates == 4
            assert model.num_timesteps - timesteps in (0, 4 * model.n_envs)
        return {setting: [1.0] * rounds for setting in runs}

    monkeypatch.setattr(scaling_points, "interleaved", one_second_each)
    monkeypatch.setattr(scaling_points, "AXES", {"n_envs": (1, 3)})
    options = f"--env Pendulum-v1 --rounds 2 --gradient-steps 4 --axes n_envs --folder {tmp_path}"
    points = scaling_points.measure(scaling.parse(options.split()))["points"]
    assert {point["gradient_step_seconds"]["median"] for point in points} == {1 / 4}
    assert [point["env_steps_per_second"]["median"] for point in points] == [4.0, 4.0, 12.0, 12.0]


@pytest.mark.parametrize("algorithm", ["CGP", "TD3"])
def test_scaling_varies_the_model(algorithm):
    varied = {"cem_iterations": 3, "cem_samples": 9, "width": 8, "action_dim": 4, "observation_dim": 11, "n_envs": 2}
    for axis, value in varied.items():
        setting = scaling_points.setting_at(algorithm, axis, value)
        model = scaling_points.make_model(setting, scaling_points.make_env(setting, "Pendulum-v1", seed=0), seed=0, device=CPU)
        assert model._n_updates == 1
        inputs = 3 + 1 if axis == "n_envs" else 11 + 6 if axis == "observation_dim" else 17 + 4 if axis == "action_dim" else 23
        first = model.critic.q_networks[0][0]
        assert (first.in_features, first.out_features) == (inputs, 8 if axis == "width" else 256)
        assert model.n_envs == (2 if axis == "n_envs" else 1)
        if algorithm == "CGP":
            assert model.cem_iterations == (3 if axis == "cem_iterations" else 2)
            assert model.cem_samples == (9 if axis == "cem_samples" else 64)


def test_latency_is_of_single_actions_that_agree(tmp_path):
    record = run_command("latency", tmp_path, "--env", "Pendulum-v1", "--rounds", "3", "--actions", "2", "--device", "cpu")
    assert list(record["ways"]) == ["`predict`", "`load_weights`", "onnxruntime"]
    for figures in record["ways"].values():
        assert len(figures["seconds"]["all"]) == 3
        assert min(figures["seconds"]["all"]) > 0.0
    assert record["ways"]["`predict`"]["ratio_to_predict"] == 1.0
    text = (tmp_path / "latency.md").read_text()
    assert "medians of 3\nrounds of 2 actions each" in text
    model = CGP("MlpPolicy", "Pendulum-v1", buffer_size=1, seed=1)
    observation = np.array([0.6, -0.8, 3.0], np.float32)
    actions = [act(observation) for act in latencies.ways_to_act(model, tmp_path / "export", threads=1).values()]
    assert [action.shape for action in actions] == [(1,)] * 3
    assert np.allclose(actions, actions[0], atol=1e-4)


def test_a_checkpoint_is_of_a_full_buffer_and_of_all_steps_since_the_last(tmp_path, monkeypatch):
    steps = []
    save = checkpoints.StateStore.save

    def counting(self, step, state):
        steps.append(step)
        return save(self, step, state)

    monkeypatch.setattr(checkpoints.StateStore, "save", counting)
    options = "--env Pendulum-v1 --transitions 200 --new 10 --rounds 2 --device cpu"
    record = run_command("checkpoint", tmp_path, *options.split())
    assert steps == [0, 10, 20, 30, 40, 50]
    seconds = record["measured"]["seconds"]
    assert list(seconds) == ["first", "second", "later", "load"]
    assert all(len(each["all"]) == 2 and min(each["all"]) > 0.0 for each in seconds.values())
    # 200 transitions of 3 + 3 + 1 + 1 numbers, at the least
    assert record["measured"]["bytes"] > 200 * 8 * 4
    assert "a replay buffer of 200 transitions" in (tmp_path / "checkpoint.md").read_text()


def test_a_buffer_is_filled_around_its_end():
    buffer = ReplayBuffer(10, gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,)))
    generator = np.random.default_rng(0)
    checkpoints.fill(buffer, 7, generator)
    assert (buffer.pos, buffer.full) == (7, False)
    before = buffer.rewards.copy()
    checkpoints.fill(buffer, 5, generator)
    assert (buffer.pos, buffer.full) == (2, True)
    changed = (buffer.rewards != before).ravel()
    assert changed.tolist() == [True] * 2 + [False] * 5 + [True] * 3


@pytest.mark.filterwarnings("ignore:.*A Box observation space:UserWarning")
def test_box_env_keeps_to_its_spaces():
    check_env(BoxEnv(5, 3), skip_render_check=True)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("runtime", "--episodes 0", "argument --episodes: '0' is not an integer >= 1"),
        ("runtime", "--episode-steps 1.5", "argument --episode-steps: '1.5' is not an integer >= 1"),
        ("runtime", "--methods PPO", "argument --methods: invalid choice: 'PPO'"),
        ("runtime", "--env Nowhere-v0", "argument --env: 'Nowhere-v0' cannot be made"),
        ("runtime", "--env CartPole-v1", "argument --env: 'CartPole-v1' has no continuous actions"),
        ("selector", "--dtypes int8", "argument --dtypes: invalid choice: 'int8'"),
        ("selector", "--threads -1", "argument --threads: '-1' is not an integer >= 1"),
        ("selector", "--device abacus", "argument --device: 'abacus' is not available"),
        ("latency", "--env CartPole-v1", "argument --env: 'CartPole-v1' has no continuous actions"),
        ("latency", "--actions 0", "argument --actions: '0' is not an integer >= 1"),
        ("scaling", "--axes seed", "argument --axes: invalid choice: 'seed'"),
        ("scaling", "--rounds many", "argument --rounds: 'many' is not an integer >= 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, capsys, name, options, message):
    with pytest.raises(SystemExit):
        COMMANDS[name].parse([*options.split(), "--folder", str(tmp_path)])
    assert message in capsys.readouterr().err


def test_missing_gpu_is_not_replaced_quietly(capsys):
    with pytest.raises(SystemExit):
        selector.parse(["--device", "cuda"])
    assert "argument --device: 'cuda' is not available" in capsys.readouterr().err
    assert arguments.device("auto") == CPU


def test_folder_that_cannot_be_made_is_named_before_anything_is_measured(tmp_path, capsys):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit):
        selector.parse(["--folder", str(tmp_path / "file" / "folder")])
    assert "argument --folder: " in capsys.readouterr().err
