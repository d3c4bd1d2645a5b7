"""The bias of critics' values: against closed forms and slow oracles, and the command that records it."""

import json
import math

import gymnasium as gym
import numpy as np
import oracles
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from tables import unpadded
from torch import nn

from benchmark import bias as command
from benchmark.values import bias, bias_page, bias_runs, episodes, methods, variants
from sb3_cgp import CGP

GAMMA = 0.99
SMALL = dict(learning_starts=20, batch_size=8, buffer_size=200, policy_kwargs=dict(net_arch=[8, 8]), seed=0)


class Counter(gym.Env):
    """Observes the number of steps so far, rewards each with 1, and terminates after some, or never."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, ends_after=None):
        self.ends_after = ends_after

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {}

    def observe(self):
        return np.array([self.steps], np.float32)

    def step(self, action):
        self.steps += 1
        return self.observe(), 1.0, self.steps == self.ends_after, False, {}


class KnownValues(nn.Module):
    """A Q-network whose value is an offset plus the state, and 1000 times the action."""

    def __init__(self, offset):
        super().__init__()
        self.offset = offset

    def forward(self, rows):
        return self.offset + rows[:, :1] + 1000 * rows[:, 1:]


def known_model(env):
    """Return a CGP whose critics are 7 and 5 plus the state, for the action 0."""
    model = CGP("MlpPolicy", env, **SMALL)
    for index, offset in enumerate((7.0, 5.0)):
        model.critic.q_networks[index] = KnownValues(offset)
    return model


def act(observations):
    return np.zeros((len(observations), 1), np.float32)


def played(model, ends_after, time_limit):
    env = gym.wrappers.TimeLimit(Counter(ends_after), time_limit)
    return bias.measure(model, episodes.play(act, [env], seed=0))


def test_bias_of_a_terminating_episode_is_exact():
    measured = played(known_model(Counter()), ends_after=4, time_limit=100)
    # With k rewards of 1 to go, the return is (1 - γ^k) / (1 - γ)
    returns = [(1 - GAMMA**to_go) / (1 - GAMMA) for to_go in (4, 3, 2, 1)]
    assert measured["discounted_return"] == pytest.approx(np.mean(returns))
    assert (measured["q1"], measured["q_min"]) == pytest.approx((7 + 1.5, 5 + 1.5))
    assert (measured["return"], measured["length"], measured["n_states"], measured["error_bound"]) == (4.0, 4.0, 4, 0.0)


def test_bias_of_a_truncated_episode_is_within_its_bound():
    measured = played(known_model(Counter()), ends_after=None, time_limit=600)
    # γ^459 is the first power below 0.01: the first 142 states have so many rewards to go
    assert GAMMA**458 > 0.01 > GAMMA**459
    assert measured["n_states"] == 142
    assert measured["q1"] == pytest.approx(7 + np.mean(range(142)))
    # Rewards of 1 for ever are worth 1 / (1 - γ). As no reward is larger, the bound is the error.
    assert 1 / (1 - GAMMA) - measured["discounted_return"] == pytest.approx(measured["error_bound"])
    assert measured["error_bound"] < 0.01 / (1 - GAMMA)


def test_too_short_a_truncated_episode_counts_no_state():
    measured = played(known_model(Counter()), ends_after=None, time_limit=458)
    assert (measured["n_states"], measured["q1"], measured["discounted_return"]) == (0, None, None)
    assert measured["return"] == 458.0


def test_a_termination_at_the_time_limit_is_a_termination():
    assert played(known_model(Counter()), ends_after=5, time_limit=5)["n_states"] == 5


def test_states_of_several_episodes_count_alike():
    envs = [gym.wrappers.TimeLimit(Counter(ends_after), 600) for ends_after in (2, 8, None)]
    batches = []

    def recording_act(observations):
        batches.append(observations[:, 0].tolist())
        return act(observations)

    found = episodes.play(recording_act, envs, seed=0)
    assert [(len(each.rewards), each.is_terminated) for each in found] == [(2, True), (8, True), (600, False)]
    # All environments at once, while they last
    assert (batches[1], batches[5], batches[9]) == ([1.0] * 3, [5.0] * 2, [9.0])
    measured = bias.measure(known_model(Counter()), found)
    states = [*range(2), *range(8), *range(142)]
    assert measured["q1"] == pytest.approx(7 + np.mean(states))
    assert measured["length"] == pytest.approx((2 + 8 + 600) / 3)


def test_episodes_begin_in_the_same_states_each_time():
    envs = [gym.make("Pendulum-v1") for _ in range(2)]
    first, again = (episodes.play(act, envs, seed=5) for _ in range(2))
    starts = [each.observations[0].tolist() for each in (*first, *again)]
    assert starts[:2] == starts[2:]
    assert starts[0] != starts[1]


def test_returns_to_go():
    assert episodes.returns_to_go([1.0, 0.0, 4.0], 0.5).tolist() == [2.0, 2.0, 4.0]


@pytest.mark.parametrize("algorithm", [CGP, TD3])
def test_values_are_those_of_scaled_actions(algorithm):
    model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL)
    observations = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    found = bias.critic_values(model, observations, np.full((3, 1), 1.0, np.float32))
    # Pendulum's torque of 1 is half of its maximum
    rows = th.cat([th.as_tensor(observations), th.full((3, 1), 0.5)], dim=1)
    expected = th.cat([q_network(rows) for q_network in model.critic.q_networks], dim=1)
    assert found == pytest.approx(expected.detach().numpy(), abs=1e-6)


@pytest.mark.parametrize("algorithm", [CGP, TD3])
def test_measuring_does_not_disturb_the_training(algorithm, monkeypatch):
    monkeypatch.setattr(episodes, "TAIL", 0.5)
    callback = bias.BiasCallback("Pendulum-v1", interval=15, n_episodes=2, episode_steps=100)
    parameters = []
    for measuring in (callback, None):
        model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL).learn(60, measuring)
        parameters.append(nn.utils.parameters_to_vector(model.policy.parameters()))
    assert parameters[0].equal(parameters[1])
    assert [point["steps"] for point in callback.points] == [30, 45, 60]
    for point in callback.points:
        assert set(point) == {"steps", *(("actor", "cem") if algorithm is CGP else ("actor",))}
        # 100 steps, of which 69 halve a reward
        assert point["actor"]["n_states"] == 2 * 32
    # Different policies act
    if algorithm is CGP:
        assert callback.points[-1]["actor"]["return"] != callback.points[-1]["cem"]["return"]


def filled_model(algorithm, **kwargs):
    """Return a model with a filled replay buffer, on a task with terminations."""
    env = gym.wrappers.TimeLimit(Counter(ends_after=5), 50)
    return algorithm("MlpPolicy", env, **(SMALL | kwargs)).learn(60)


def value(q_network, features, action):
    """Return the value of one state and action, by a slow oracle."""
    layers = [layer for layer in q_network if isinstance(layer, nn.Linear)]
    weights, biases = ([getattr(layer, name).detach() for layer in layers] for name in ("weight", "bias"))
    return float(oracles.mlp(weights, biases, th.cat([features.flatten(), action.detach().flatten()])))


def targets_of(model, monkeypatch):
    """Return the critics' targets in one gradient step, with the batch and the bootstrap actions."""
    batches, actions, targets = [], [], []
    sample = model.replay_buffer.sample

    def recording_sample(*args, **kwargs):
        batches.append(sample(*args, **kwargs))
        return batches[-1]

    def recording_mse(values, target):
        targets.append(target)
        return (values - target).square().mean()

    with monkeypatch.context() as patch:
        patch.setattr(model.replay_buffer, "sample", recording_sample)
        patch.setattr("sb3_cgp.core.cgp.F.mse_loss", recording_mse)
        hook = model.critic_target.register_forward_pre_hook(lambda _, inputs: actions.append(inputs[1]))
        model.train(gradient_steps=1, batch_size=16)
        hook.remove()
    return batches[0], actions[0], targets[0].flatten().tolist()


def transitions(batch, actions):
    return zip(batch.rewards, batch.dones, batch.next_observations, actions, strict=True)


def test_target_is_floored_at_the_averaged_actor(monkeypatch):
    # The update of the averages would come before the oracle
    model = filled_model(variants.FlooredCGP, target_update_interval=1000)
    # Critics that prefer different actions, so that CEM's action by the first one is no good choice for the minimum
    for q_network, sign in zip(model.critic_target.q_networks, (1, -1), strict=True):
        q_network[-1].weight.data.mul_(30 * sign)
    batch, actions, targets = targets_of(model, monkeypatch)
    raised = 0
    for target, (reward, done, state, action) in zip(targets, transitions(batch, actions), strict=True):
        averaged = model.actor_target(state[None])[0]
        of_action, of_actor = (
            min(value(q_network, state, each) for q_network in model.critic_target.q_networks) for each in (action, averaged)
        )
        raised += of_actor > of_action and not done
        expected = oracles.bootstrap_target(float(reward), bool(done), GAMMA, [max(of_action, of_actor)])
        assert target == pytest.approx(expected, abs=1e-4)
    assert 0 < raised < len(targets)


def test_target_is_clamped_to_the_range_of_earlier_targets(monkeypatch):
    monkeypatch.setattr(variants.ClampedCGP, "RANGE_INTERVAL", 3)
    model = filled_model(variants.ClampedCGP, target_update_interval=1000, learning_starts=59)
    for q_network in model.critic_target.q_networks:
        q_network[-1].weight.data.mul_(30)
    low, high, seen, clamped = 0.0, 0.0, list(model.seen_range), 0
    # `learn` has taken one step
    for step in range(2, 9):
        batch, actions, targets = targets_of(model, monkeypatch)
        for target, (reward, done, state, action) in zip(targets, transitions(batch, actions), strict=True):
            least = min(value(q_network, state, action) for q_network in model.critic_target.q_networks)
            clamped += step > 3 and not low <= least <= high
            expected = oracles.bootstrap_target(float(reward), bool(done), GAMMA, [min(max(least, low), high)])
            assert target == pytest.approx(expected, abs=1e-4)
        seen += targets
        if step % 3 == 0:
            low, high = min(seen), max(seen)
    assert model.clamp_range == pytest.approx((low, high))
    assert high > 0.0
    assert clamped > 0


@pytest.mark.parametrize("name", ["critic", "critic_target"])
@pytest.mark.parametrize(("cem_dtype", "tolerance"), [("float32", 1e-4), ("bfloat16", 0.05)])
def test_score_is_the_minimum_of_both_critics(name, cem_dtype, tolerance):
    model = CGP(variants.MinScorePolicy, "Pendulum-v1", cem_dtype=cem_dtype, **SMALL)
    critic = getattr(model, name)
    th.manual_seed(1)
    features, actions = th.randn(9, 3), th.rand(9, 5, 1) * 2 - 1
    with th.no_grad():
        # Each of them is the smaller one for some states
        for q_network in critic.q_networks:
            q_network[-1].weight.mul_(3)
            q_network[-1].bias.sub_(q_network(th.cat([features, actions[:, 0]], dim=1)).mean())
        scores = model.policy.make_score(critic.q_networks[0], features)(actions)
    chosen = set()
    for state in range(9):
        for sample in range(5):
            values = [value(q_network, features[state], actions[state, sample]) for q_network in critic.q_networks]
            assert float(scores[state, sample]) == pytest.approx(min(values), abs=tolerance)
            chosen.add(int(np.argmin(values)))
    assert chosen == {0, 1}


def test_score_is_nan_where_one_critic_is():
    model = CGP(variants.MinScorePolicy, "Pendulum-v1", **SMALL)
    model.critic.q_networks[1][-1].bias.data.fill_(th.nan)
    assert model.policy.make_score(model.critic.q_networks[0], th.zeros(2, 3))(th.zeros(2, 4, 1)).isnan().all()


@pytest.mark.parametrize("name", methods.METHODS)
def test_methods_are_what_their_names_say(name):
    model = methods.make_model(name, "Pendulum-v1", units=8, seed=0, device=th.device("cpu"), learning_starts=10)
    model.learn(20)
    assert model._n_updates == 10
    assert model.critic.q_networks[0][0].out_features == 8
    if name == "TD3":
        assert type(model) is TD3
        assert model.action_noise._sigma.tolist() == [0.1]
        return
    assert model.inference is None
    expected = {"CGP-Light": ("actor", 1, 16)}.get(name, ("prior", int(name.split("-")[1]) if name != "CGP-Light" else 1, 64))
    assert (model.cem_start, model.cem_iterations, model.cem_samples) == expected
    assert model.cem_result == ("mean" if name.endswith("mean") else "best")


TINY = ["--env", "Pendulum-v1", "--steps", "40", "--learning-starts", "10", "--units", "8", "--batch-size", "8"]
TINY += ["--gamma", "0.99", "--interval", "20", "--episodes", "1", "--episode-steps", "460"]


def test_command_records_runs_as_they_end_and_continues(tmp_path, monkeypatch):
    options = [*TINY, "--folder", str(tmp_path), "--methods", "CGP-Light", "TD3", "--seeds", "3", "4"]
    run, asked = bias_runs.run, []

    def interrupted_run(method, seed, args, argv):
        asked.append((method, seed))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return run(method, seed, args, argv)

    monkeypatch.setattr(bias_runs, "run", interrupted_run)
    with pytest.raises(KeyboardInterrupt):
        command.main(options)
    assert len(list(tmp_path.glob("*.json"))) == 2
    command.main(options)
    assert asked == [("CGP-Light", 3), ("TD3", 3), ("CGP-Light", 4), ("CGP-Light", 4), ("TD3", 4)]
    record = json.loads((tmp_path / "Pendulum-v1_CGP-Light_seed4.json").read_text())
    assert record["command"].startswith("python -m benchmark.bias --env Pendulum-v1")
    assert [point["steps"] for point in record["points"]] == [20, 40]
    assert record["points"][1]["actor"]["n_states"] == 2
    assert (tmp_path / "bias.png").read_bytes().startswith(b"\x89PNG")
    assert "| CGP-Light | 3, 4 |" in unpadded((tmp_path / "bias.md").read_text())


def test_command_refuses_other_settings_in_one_folder(tmp_path, capsys):
    options = [*TINY, "--folder", str(tmp_path), "--methods", "TD3", "--seeds", "3"]
    command.main(options)
    with pytest.raises(SystemExit):
        command.main([*options, "--units", "16"])
    assert "holds runs with units=8: choose another --folder for units=16" in capsys.readouterr().err


def test_command_refuses_episodes_too_short_for_a_return(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--episode-steps", "458"])
    assert "458 must be at least 459" in capsys.readouterr().err


@pytest.mark.parametrize("gamma", ["1", "0", "nan", "much"])
def test_command_refuses_a_discount_without_a_horizon(gamma, tmp_path, capsys):
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--gamma", gamma])
    assert f"{gamma!r} is not a number above 0 and below 1" in capsys.readouterr().err


def test_command_refuses_observations_of_several_parts(tmp_path, capsys, monkeypatch):
    parts = spaces.Dict(x=Counter.observation_space)
    monkeypatch.setattr(Counter, "observation_space", parts)
    monkeypatch.setitem(gym.registry, "Parts-v0", gym.envs.registration.EnvSpec("Parts-v0", entry_point=Counter))
    with pytest.raises(SystemExit):
        command.main([*TINY, "--folder", str(tmp_path), "--env", "Parts-v0"])
    assert "Parts-v0 must have vectors as observations" in capsys.readouterr().err


def test_page_averages_the_second_half_of_the_training():
    def measured(q1, discounted_return):
        more = {"q_min": q1 - 1.0, "return": 50.0, "length": 10.0, "n_states": 10, "error_bound": 0.25}
        return more | {"q1": q1, "discounted_return": discounted_return}

    def record(seed, late):
        points = [(50, 1000.0), (60, late), (100, late + 2.0)]
        return {
            "method": "TD3",
            "seed": seed,
            "settings": dict(
                env="Env-v0",
                units=8,
                batch_size=9,
                gamma=GAMMA,
                tau=0.5,
                steps=100,
                learning_starts=10,
                episodes=2,
                episode_steps=460,
            ),
            "points": [{"steps": steps, "actor": measured(q1, 10.0)} for steps, q1 in points],
            "command": "python -m benchmark.bias",
            "commit": "abc",
            "versions": {},
            "machine": dict(gpu=None, device="cpu", torch_threads=1, cpu="cpu", cpu_capability="x", cores=1, cem_dtype="y"),
            "load_average": 0.0,
        }

    text = unpadded(bias_page.markdown([record(0, 15.0), record(1, 25.0)]))
    assert "| TD3 | 0, 1 | 11.0 (6.0 to 16.0) | 10.0 (5.0 to 15.0) | 21.0 (16.0 to 26.0) | 10.0 (10.0 to 10.0) |" in text
    assert "the 2 measurements in the second half of 100 steps on Env-v0" in " ".join(text.split())
    assert "no bias by more than 0.25 (0 if" in " ".join(text.split())


def test_horizon():
    assert episodes.horizon(0.99) == 459
    assert math.isclose(0.5 ** episodes.horizon(0.5), 1 / 128)


def test_figure_has_at_most_four_methods_a_panel_and_every_seed(monkeypatch):
    def run(method, seed):
        values = {"q1": 3.0 + seed, "q_min": 2.0, "discounted_return": 1.0, "return": 5.0 * seed}
        return {"method": method, "seed": seed, "points": [{"steps": steps, "actor": values} for steps in (10, 20)]}

    kept = []
    monkeypatch.setattr(bias_page, "png", lambda figure: kept.append(figure) or b"")
    bias_page.draw([run(method, seed) for method in methods.METHODS for seed in (0, 1)])
    panels = kept[0].axes
    assert len(panels) == 2 * len(bias_page.ROWS)
    assert {method for row in bias_page.ROWS for method in row} == set(methods.METHODS)
    for row, left, right in zip(bias_page.ROWS, panels[::2], panels[1::2], strict=True):
        assert len(row) <= 4
        for panel, low, mean, high in ((left, 2.0, 2.5, 3.0), (right, 0.0, 2.5, 5.0)):
            lines = [line for line in panel.get_lines() if len(line.get_xdata()) == 2 and line.get_xdata()[1] == 20]
            assert [line.get_ydata()[0] for line in lines] == [low, high, mean] * len(row)
        assert sorted(text.get_text() for text in right.texts) == sorted(row)
        assert (left.get_ylim(), right.get_ylim()) == (panels[0].get_ylim(), panels[1].get_ylim())
    bias_page.draw([run("TD3", 0)])
    assert len(kept[1].axes) == 2
