"""A training that ends before the first gradient step says so, and no other does."""

import re
import warnings

import gymnasium as gym
import pytest
from guarded import SMALL, GuardedTD3, located
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cgp.population import Population
from sb3_cgp.resumption.algorithm import resumable
from sb3_cgp.resumption.callbacks import TrainingCheckpointCallback

POPULATION = dict(buffer_size=100, batch_size=4, policy_kwargs=dict(net_arch=[4]), device="cpu")


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("train_freq", [1, 4, (1, "episode"), (2, "episode")], ids=str)
@pytest.mark.parametrize("gradient_steps", [1, -1])
@pytest.mark.parametrize("learning_starts", [0, 9, 12, 20])
@pytest.mark.parametrize("first_steps", [0, 4])
def test_a_training_without_a_gradient_step_warns_and_no_other_does(
    n_envs, train_freq, gradient_steps, learning_starts, first_steps
):
    if n_envs > 1 and isinstance(train_freq, tuple):
        return
    arguments = SMALL | dict(train_freq=train_freq, gradient_steps=gradient_steps, learning_starts=learning_starts)
    model = GuardedTD3("MlpPolicy", located(n_envs, length=5), **arguments)
    n_warnings = 0
    for total_timesteps in (first_steps, 8, 2) if first_steps else (9,):
        updates = model._n_updates
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            model.learn(total_timesteps, reset_num_timesteps=not first_steps)
        # Once of trainings that continue each other
        assert len(warned) == (model._n_updates == updates and n_warnings == 0)
        n_warnings += len(warned)
        if warned:
            message = str(warned[0].message)
            assert message.startswith("Nothing is learnt yet: " if first_steps else "Nothing is learnt: ")
            assert f"ends at environment step {model.num_timesteps}, " in message
            assert f"after step learning_starts={learning_starts}" in message


@pytest.mark.parametrize("n_steps", [1, 100])
def test_a_loop_of_trainings_that_continue_each_other_is_not_told_to_change_what_is_right(n_steps, capsys):
    model = GuardedTD3("MlpPolicy", located(), **(SMALL | dict(learning_starts=3 * n_steps, verbose=1)))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for _ in range(5):
            model.learn(n_steps, reset_num_timesteps=False)
    assert model._n_updates == 2 * n_steps
    expected = r"Nothing is learnt yet: .* Continue with `reset_num_timesteps=False` beyond that step\. This is said once\."
    assert re.match(expected, *(str(each.message) for each in warned))
    assert "smaller `learning_starts`" not in f"{warned[0].message}{capsys.readouterr().out}"
    # A training that begins anew is judged alone
    with pytest.warns(UserWarning, match=r"Nothing is learnt: .* a smaller `learning_starts`, such as"):
        model.learn(n_steps)
    with pytest.warns(UserWarning, match="Nothing is learnt yet: "):
        model.learn(n_steps, reset_num_timesteps=False)


def limited(length):
    """An environment without an end of its own, and Gymnasium's limit."""
    return gym.make("Pendulum-v1", max_episode_steps=length)


class Started(BaseCallback):
    """Notes how many warnings there were at the first step."""

    def __init__(self, warned):
        super().__init__()
        self.warned, self.before = warned, None

    def _on_step(self):
        self.before = len(self.warned) if self.before is None else self.before
        return True


@pytest.mark.parametrize("frequency", [1, 3])
@pytest.mark.parametrize("learning_starts", [12, 15, 16, 25, 26])
def test_episodes_that_cannot_become_long_enough_are_warned_of_before_the_first_step(frequency, learning_starts):
    arguments = SMALL | dict(train_freq=(frequency, "episode"), learning_starts=learning_starts)
    model = GuardedTD3("MlpPolicy", limited(5), **arguments)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        started = Started(warned)
        model.learn(11, started)
    # The last rollout begins at step 10 at the latest
    cannot = 10 + 5 * frequency <= learning_starts
    assert started.before == cannot
    assert len(warned) == (model._n_updates == 0)
    assert (f"ends at environment step {10 + 5 * frequency} at the latest" in str(warned[0].message)) if cannot else True


@pytest.mark.parametrize(
    ("steps", "remedy"),
    [((50,), "such as 5."), ((150, 50), "such as 5, or continue .* `reset_num_timesteps=False`.")],
)
def test_the_remedy_takes_gradient_steps(steps, remedy):
    model = GuardedTD3("MlpPolicy", located(), **(SMALL | dict(learning_starts=100)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for n in steps[:-1]:
            model.learn(n)
    before = model._n_updates
    with pytest.warns(UserWarning, match=remedy) as warned:
        model.learn(steps[-1])
    assert model._n_updates == before
    fresh = GuardedTD3("MlpPolicy", located(), **SMALL)
    fresh.learning_starts = int(re.search(r"such as (\d+)", str(warned[0].message))[1])
    fresh.learn(steps[-1])
    assert fresh._n_updates > 0


@pytest.mark.parametrize(
    ("verbose", "learning_starts", "printed"),
    [(0, 12, ""), (1, 0, ""), (1, 6, "Actions are random in the next 6 of 20 environment steps (learning_starts=6), "),
     (1, 12, "without gradient steps. That is more than half: a smaller `learning_starts` trains more.")],
)  # fmt: skip
def test_the_share_of_random_steps_is_printed_with_verbose(verbose, learning_starts, printed, capsys):
    arguments = SMALL | dict(learning_starts=learning_starts, verbose=verbose)
    model = GuardedTD3("MlpPolicy", located(), **arguments)
    capsys.readouterr()
    model.learn(20)
    found = capsys.readouterr().out
    assert printed in found
    assert ("Actions are random" in found) == bool(printed)
    assert ("more than half" in found) == ("more than half" in printed)


@pytest.mark.parametrize(
    ("starts", "steps", "printed"),
    [
        ((10, 10), 60, "in the next 10 of 30 environment steps of each agent (learning_starts=10), without gradient steps."),
        ((4, 12), 60, "in the next 4 to 12 of 30 environment steps of each agent (learning_starts=4 to 12), without"),
        ((0, 40), 61, "in the next 0 to 31 of 31 environment steps of each agent (learning_starts=0 to 40), without"),
        ((1000, 1000), 2200, "in the next 1,000 of 1,100 environment steps of each agent (learning_starts=1000), without"),
        ((10,), 60, "in the next 10 of 60 environment steps (learning_starts=10), without gradient steps."),
    ],
)
def test_a_population_counts_the_random_steps_of_an_agent(starts, steps, printed, capsys):
    """As the argument does, and not those of all environments, which SB3 counts."""
    agents = [dict(learning_starts=start) for start in starts]
    population = Population("MlpPolicy", "Pendulum-v1", agents, **(POPULATION | dict(verbose=1)))
    population._setup_learn(steps)
    assert f"Actions are random {printed}" in capsys.readouterr().out


def test_a_population_that_learns_nothing_is_warned_of_by_the_steps_of_an_agent():
    population = Population("MlpPolicy", "Pendulum-v1", 4, **(POPULATION | dict(learning_starts=50)))
    message = (
        r"ends at environment step 20 of each agent, and gradient steps begin after step learning_starts=50\. .* such as 2\."
    )
    with pytest.warns(UserWarning, match=message):
        population.learn(80)


def test_a_population_whose_trainings_continue_each_other_is_warned_once():
    population = Population("MlpPolicy", "Pendulum-v1", [dict(learning_starts=each) for each in (0, 50)], **POPULATION)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for _ in range(3):
            population.learn(20, reset_num_timesteps=False)
    assert re.match(
        "Agent 1 learns nothing yet: .* step 10 of each agent, .*=50. Continue", *(str(each.message) for each in warned)
    )


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ((0, 20, 3), "Agent 1 learns nothing: .* and their gradient steps begin after step learning_starts=20"),
        ((50, 5, 20), "Agents 0 and 2 learn nothing: the training ends at environment step 20 of each agent, .*=20 to 50"),
        ((30, 20, 19, 20), "Agents 0, 1 and 3 learn nothing: .* smaller `learning_starts`, such as 2[.]"),
        ((19, 19), None),
    ],
)
def test_agents_of_a_population_that_learn_nothing_are_named(starts, message, overlap):
    population = Population(
        "MlpPolicy", "Pendulum-v1", [dict(learning_starts=each) for each in starts], overlap=overlap, **POPULATION
    )
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        started = Started(warned)
        population.learn(20 * len(starts), started)
    assert [agent for agent, n in enumerate(population._agent_updates) if n == 0] == [
        agent for agent, start in enumerate(starts) if start >= 20
    ]
    assert len(warned) == started.before == (message is not None)
    assert message is None or re.search(message, str(warned[0].message))


@pytest.mark.filterwarnings("error")
def test_a_training_that_is_not_to_learn_or_to_step_is_not_warned_of():
    GuardedTD3("MlpPolicy", located(), **(SMALL | dict(gradient_steps=0))).learn(5)
    GuardedTD3("MlpPolicy", located(), **SMALL).learn(0)


@pytest.mark.parametrize(("stop", "n_warnings"), [(8, 1), (18, 0), (30, 0)])
@pytest.mark.filterwarnings("ignore:The environment's state was not saved")
def test_a_resumed_training_is_judged_by_the_steps_that_are_left(stop, n_warnings, tmp_path):
    """Of 30 steps: all of those that are left are random, some are, or none is left."""
    algorithm = resumable(GuardedTD3)
    arguments = SMALL | dict(learning_starts=30 if n_warnings else 20, gradient_steps=1)
    model = algorithm("MlpPolicy", located(length=5), **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(stop, TrainingCheckpointCallback(2, tmp_path))
    resumed = algorithm.resume(tmp_path, located(length=5))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        resumed.learn(30, TrainingCheckpointCallback(2, tmp_path))
    assert resumed.num_timesteps == 30
    assert len([each for each in warned if "Nothing is learnt" in str(each.message)]) == n_warnings
