"""Tasks whose values have several maxima in the action: their rules, their registration, and who finds the highest maximum."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environment_states import environment_state
from gymnasium.utils.env_checker import check_env as check_by_gymnasium
from stable_baselines3 import TD3
from stable_baselines3.common.env_checker import check_env as check_by_sb3
from stable_baselines3.common.vec_env import DummyVecEnv

import benchmark.tasks  # noqa: F401
from benchmark.sweeps.experiments import included_sweeps, load_sweep
from benchmark.tasks.landscape import KnownMaxima
from benchmark.tasks.registration import LANDSCAPES, ORIGINALS
from benchmark.tasks.zones import AllowedZones, unit_radius
from sb3_cgp import CEM, CGP
from sb3_cgp.resumption.environments import restore_environment

RESTRICTED = [f"Restricted{original}" for original in ORIGINALS]
TASKS = [*RESTRICTED, *LANDSCAPES]


class Recorder(gym.Env):
    """Records the actions that reach it."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, low=-1.0, high=1.0, dim=1, dtype=np.float32):
        self.action_space = gym.spaces.Box(np.full(dim, low, dtype), np.full(dim, high, dtype), dtype=dtype)
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.actions.append(action)
        return np.zeros(1, np.float32), 0.0, False, False, {"kept": True}


def acting(env, action):
    """Return the action that reaches the environment, and whether the wrapper calls the given one allowed."""
    _, _, _, _, info = env.step(np.array(action, env.action_space.dtype))
    assert info["kept"]
    return env.unwrapped.actions[-1].tolist(), info["allowed"]


@pytest.mark.parametrize(("levels", "dim"), [(2, 1), (3, 1), (4, 1), (3, 2), (3, 3), (2, 4)])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_agrees_with_a_search_among_all_centres(levels, dim, share):
    env = AllowedZones(Recorder(dim=dim), levels, share)
    centres = list(itertools.product([-1 + 2 * number / (levels - 1) for number in range(levels)], repeat=dim))
    actions = np.random.default_rng(0).uniform(-1, 1, (4_000, dim))
    oracle = [min(math.dist(action, centre) for centre in centres) <= env.radius for action in actions]
    assert [env.is_allowed(action) for action in actions] == oracle
    # Six standard errors, and the radius's own error
    assert np.mean(oracle) == pytest.approx(share, abs=6 * math.sqrt(share * (1 - share) / len(actions)))


def test_radius_is_that_of_disjoint_balls():
    """Where the balls are disjoint, their volume is known."""
    for share in (0.1, 0.5):
        assert unit_radius(1, share) == pytest.approx(share / 2, rel=1e-3)
        assert unit_radius(2, share) == pytest.approx(math.sqrt(share / math.pi), rel=2e-3)
        assert unit_radius(3, share) == pytest.approx((share * 3 / (4 * math.pi)) ** (1 / 3), rel=1e-3)


@pytest.mark.parametrize(
    ("action", "acts"),
    [([0.0], True), ([0.24], True), ([0.26], False), ([-0.74], False), ([-0.76], True), ([1.0], True), ([-1.0], True)],
)
def test_one_dimension_by_hand(action, acts):
    """Half of the line: a quarter on each side of -1, 0 and 1, as far as it lies within the bounds."""
    env = AllowedZones(Recorder())
    assert acting(env, action) == (pytest.approx(action if acts else [0.0]), acts)


def test_balls_are_round():
    env = AllowedZones(Recorder(dim=2))
    near = 0.39 / math.sqrt(2)
    assert acting(env, [near, near])[1]
    assert not acting(env, [0.39, 0.39])[1]
    assert acting(env, [0.39, 0.0])[1]
    assert acting(env, [-1.0, 0.39]) == (pytest.approx([-1.0, 0.39]), True)


@pytest.mark.parametrize(("low", "high"), [(-2.0, 2.0), (0.0, 10.0), (-3.0, 1.0)])
def test_zones_scale_with_the_bounds(low, high):
    env, reference = AllowedZones(Recorder(low, high)), AllowedZones(Recorder())
    middle = (low + high) / 2
    for scaled in np.linspace(-1, 1, 41) + 0.001:
        action = middle + scaled * (high - low) / 2
        acted, allowed = acting(env, [action])
        assert allowed == acting(reference, [scaled])[1]
        assert acted == pytest.approx([action if allowed else middle], abs=1e-5)


def test_actions_beyond_the_bounds_and_nan_reach_the_environment():
    """An action beyond its bounds lies in the zone of the bound, and NaN is left to those who look for it."""
    env = AllowedZones(Recorder())
    assert acting(env, [7.0]) == ([7.0], True)
    acted, allowed = acting(env, [np.nan])
    assert allowed
    assert np.isnan(acted).all()


@pytest.mark.parametrize("levels", [3, 5])
def test_neutral_and_full_power_are_allowed_in_all_combinations(levels):
    env = AllowedZones(Recorder(dim=3), levels, 0.01)
    assert all(env.is_allowed(np.array(action)) for action in itertools.product([-1, 0, 1], repeat=3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(levels=1), "`levels` is 1, but must be an integer >= 2"),
        (dict(levels=2.5), "`levels` is 2.5, but must be an integer >= 2"),
        (dict(share=0), "`share` is 0, but must be a number between 0 and 1"),
        (dict(share=1.0), "`share` is 1.0, but must be a number between 0 and 1"),
        (dict(share=float("nan")), "`share` is nan, but must be a number between 0 and 1"),
        (dict(share=True), "`share` is True, but must be a number between 0 and 1"),
        (dict(share="half"), "`share` is 'half', but must be a number between 0 and 1"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    for make in (lambda: AllowedZones(Recorder(), **arguments), lambda: gym.make("RestrictedPendulum-v1", **arguments)):
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(3),
        gym.spaces.Box(-np.inf, np.inf, (1,)),
        gym.spaces.Box(0, 9, (1,), np.int64),
        gym.spaces.Box(2.0, 2.0, (1,)),
    ],
)
def test_other_action_spaces_are_refused(space):
    env = Recorder()
    env.action_space = space
    with pytest.raises(ValueError, match=r"`env.action_space` is .*, but must be a Box of floats with finite bounds"):
        AllowedZones(env)


@pytest.mark.parametrize("task", TASKS)
def test_environments_pass_the_checks(task):
    check_by_sb3(gym.make(task), warn=False)
    # Rendering needs a display
    check_by_gymnasium(gym.make(task, disable_env_checker=True), skip_render_check=True)


@pytest.mark.parametrize("original", ORIGINALS)
def test_restricted_tasks_are_the_original_ones_but_for_forbidden_actions(original):
    """Step by step the original under the same actions, with no torque in place of forbidden ones."""
    task = f"Restricted{original}"
    env, plain = gym.make(task), gym.make(original)
    assert env.spec.max_episode_steps == plain.spec.max_episode_steps
    assert isinstance(env, gym.wrappers.TimeLimit)
    assert (env.spec.id, env.action_space, env.observation_space) == (task, plain.action_space, plain.observation_space)
    # The zones do not depend on the seeds of the environment or of NumPy
    np.random.seed(1)  # noqa: NPY002
    other = gym.make(task)
    first, _ = env.reset(seed=3)
    assert np.array_equal(first, plain.reset(seed=3)[0])
    other.reset(seed=4)
    env.action_space.seed(0)
    seen = set()
    for _ in range(40):
        action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        seen.add(info["allowed"])
        assert other.step(action)[4]["allowed"] == info["allowed"]
        expected = plain.step(action if info["allowed"] else np.zeros_like(action))
        assert np.array_equal(observation, expected[0])
        assert (reward, terminated, truncated) == expected[1:4]
        if terminated or truncated:
            break
    assert seen == {True, False}


@pytest.mark.parametrize("original", ["Pendulum-v1", "Reacher-v5"])
def test_restricted_tasks_time_out_where_the_original_does(original):
    env, limit = gym.make(f"Restricted{original}"), gym.spec(original).max_episode_steps
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(limit)]
    assert ends == [(False, False)] * (limit - 1) + [(False, True)]


def test_specs_and_arguments_make_the_same_task_again():
    env = gym.make("RestrictedPendulum-v1", levels=5, share=0.2, g=1.0)
    again = gym.make(env.spec)
    for each in (env, again):
        assert each.get_wrapper_attr("radius") == pytest.approx(0.05, rel=1e-3)
        assert each.unwrapped.g == 1.0
    assert str(env) == str(again)


@pytest.mark.parametrize("task", ["RestrictedReacher-v5", "KnownMaxima-v0"])
def test_a_stopped_training_goes_on_in_the_same_state(task):
    venv, other = (DummyVecEnv([lambda: gym.make(task)]) for _ in range(2))
    venv.seed(0)
    venv.reset()
    venv.step([venv.action_space.sample()])
    restore_environment(other, environment_state(venv))
    action = [venv.action_space.sample()]
    for ours, theirs in zip(venv.step(action)[:3], other.step(action)[:3], strict=True):
        assert np.array_equal(ours, theirs)


def landscape_score(env):
    """Return the score of actions, (B, N, A) -> (B, N), on a landscape, by a transcription in PyTorch."""

    def score(actions):
        bumps = [
            height * th.exp(-(actions - position).square().mean(dim=-1) / (2 * width**2))
            for position, height, width in zip(env.positions, env.heights, env.widths, strict=True)
        ]
        return th.stack(bumps).amax(dim=0)

    return score


@pytest.mark.parametrize("action_dim", [1, 3])
def test_rewards_of_the_landscape(action_dim):
    env = gym.make({1: "KnownMaxima-v0", 3: "KnownMaxima3D-v0"}[action_dim])
    assert env.action_space.shape == (action_dim,)
    env.reset(seed=0)
    at_higher, at_lower = np.full(action_dim, 0.7, np.float32), np.full(action_dim, -0.4, np.float32)
    assert env.step(at_higher)[1:4] == (pytest.approx(1.0), True, False)
    assert env.unwrapped.reward_of(at_lower) == pytest.approx(0.5)
    # A width away from the lower maximum
    assert env.unwrapped.reward_of(np.zeros(action_dim)) == pytest.approx(0.5 * math.exp(-0.5))
    actions = np.random.default_rng(0).uniform(-1, 1, (5, 7, action_dim))
    oracle = landscape_score(env.unwrapped)(th.tensor(actions))
    assert np.allclose(env.unwrapped.reward_of(actions), oracle.numpy())


@pytest.mark.parametrize("arguments", [{}, dict(positions=(-0.8, 0.1, 0.9), heights=(1, 2, 0.5), widths=(0.1, 0.2, 0.1))])
@pytest.mark.parametrize("action_dim", [1, 2])
def test_maxima_are_those_of_a_dense_grid(arguments, action_dim):
    """Points of the grid that exceed all their neighbours are the maxima, and no others."""
    env = KnownMaxima(action_dim, **arguments)
    axis = np.linspace(-1, 1, 101)
    grid = np.stack(np.meshgrid(*[axis] * action_dim, indexing="ij"), axis=-1)
    rewards = np.pad(env.reward_of(grid), 1, constant_values=-np.inf)
    inner = (slice(1, -1),) * action_dim
    exceeds = np.ones_like(rewards, dtype=bool)
    for shift in itertools.product([-1, 0, 1], repeat=action_dim):
        if any(shift):
            exceeds &= rewards > np.roll(rewards, shift, axis=tuple(range(action_dim)))
    found = grid[exceeds[inner]]
    order = np.argsort(env.positions)
    assert np.allclose(found, env.maxima[order])
    assert np.allclose(env.reward_of(found), env.heights[order])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(action_dim=0), "`action_dim` is 0, but must be an integer >= 1"),
        (dict(positions=()), r"`positions` is \(\), but must be at least one number"),
        (dict(positions=(0.0, 1.5)), r"`positions` is 1.5, but must be a number within \[-1, 1\]"),
        (dict(heights=(1.0,)), r"`heights` is \(1.0,\), but must be a number for each of 2 positions"),
        (dict(heights=(1.0, -1.0)), "`heights` is -1.0, but must be a finite number >= 0"),
        (dict(heights=(1.0, 0.0)), "`heights` is 0.0, but must be more than 0"),
        (dict(widths=(0.1, 0.0)), "`widths` is 0.0, but must be more than 0"),
        (dict(widths=(0.1, float("inf"))), "`widths` is inf, but must be a finite number >= 0"),
        (dict(positions=(0.6, 0.7)), r"`positions` is \(0.6, 0.7\), but must be further from each other"),
    ],
)
def test_wrong_landscapes_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        KnownMaxima(**arguments)


@pytest.mark.parametrize("action_dim", [1, 2, 3])
def test_cem_finds_the_higher_maximum_and_gradients_do_not(action_dim):
    env = KnownMaxima(action_dim)
    score = landscape_score(env)
    th.manual_seed(0)
    found = CEM(iterations=5, samples=1_000, elites=5).select(score, 20, action_dim).actions
    assert th.allclose(found, th.full_like(found, 0.7), atol=0.05)

    # From where a new actor starts
    actions = (0.05 * th.randn(20, 1, action_dim)).requires_grad_()
    for _ in range(1_000):
        (gradient,) = th.autograd.grad(score(actions).sum(), actions)
        actions = (actions + 0.05 * gradient).detach().requires_grad_()
    assert th.allclose(actions, th.full_like(actions, -0.4), atol=0.01)


@pytest.mark.parametrize(("dim", "share_of_best"), [(1, 0.25), (2, 0.31), (3, 0.33), (6, 0.48)])
def test_an_ascent_within_the_zones_ends_far_below_the_best_allowed_action(dim, share_of_best):
    """The numbers of the documentation: values that are linear in the action, whose best allowed action is a corner."""
    env = AllowedZones(Recorder(dim=dim))
    slopes = np.random.default_rng(0).normal(size=(100, dim))
    slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
    reached = []
    for slope in slopes:
        action = np.zeros(dim)
        while env.is_allowed(further := np.clip(action + 0.01 * slope, -1, 1)) and (further != action).any():
            action = further
        assert env.is_allowed(np.sign(slope))
        reached.append(action @ slope / np.abs(slope).sum())
    assert np.mean(reached) == pytest.approx(share_of_best, abs=0.03)


@pytest.mark.filterwarnings("ignore:Nothing is learnt")
def test_actors_by_gradients_climb_to_the_lower_maximum_and_cgp_imitates_the_higher_one():
    """From a critic that knows both maxima, and an actor between them that has not been trained."""
    arguments = dict(learning_starts=300, learning_rate=3e-3, gamma=0.0, policy_kwargs=dict(net_arch=[32, 32]), seed=0)
    found = {}
    for name, algorithm, further in (("TD3", TD3, {}), ("QGP", CGP, {"policy_loss": "qgp"}), ("CGP", CGP, {})):
        # Random steps, then the critic alone, and then both
        model = algorithm("MlpPolicy", "KnownMaxima-v0", policy_delay=10**6, device="cpu", **arguments, **further).learn(300)
        model.train(200, 64)
        assert -0.4 < model.predict(np.zeros(1, np.float32))[0] < 0.1
        model.policy_delay = 1
        model.train(60, 64)
        found[name] = float(model.predict(np.zeros(1, np.float32))[0][0])
    assert found["TD3"] == pytest.approx(-0.4, abs=0.2)
    assert found["QGP"] == pytest.approx(-0.4, abs=0.2)
    # The critic's own maximum is not exactly that of the rewards
    assert found["CGP"] == pytest.approx(0.7, abs=0.3)


def test_sweep_of_the_tasks():
    names = included_sweeps("e10")
    sweeps = [load_sweep(name) for name in names]
    assert sorted(task for sweep in sweeps for task in sweep.file.tasks) == sorted(TASKS)
    for sweep in sweeps:
        assert sweep.methods.keys() == {"CGP-Online", "CGP-Light", "CEM", "QGP-Online", "TD3", "SAC"}
        assert sweep.seeds == [0, 1, 2, 3, 4]
        assert sweep.file.steps == 20 * sweep.file.evaluation_interval
        assert all(run.gym_packages == ["benchmark.tasks"] for run in sweep.runs())
        (width,) = {run.hyperparams["policy_kwargs"] for run in sweep.runs()}
        assert width == "dict(net_arch=[64, 64])"
