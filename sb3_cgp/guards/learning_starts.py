"""Trainings that end before the first gradient step."""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_cgp.guards.observations import innermost


class LearningStartsGuard(OffPolicyAlgorithm):
    """
    An algorithm that warns if ``learn`` does no gradient step, for ``learning_starts`` is too large.

    Of several agents that the environments are divided among, it names those that learn nothing.

    It warns when the training starts. Where the length of the last episode decides, and episodes have no known limit, it warns
    when the training has ended. It does not warn of ``gradient_steps=0``, which says so itself. Of trainings that continue
    each other, with ``reset_num_timesteps=False``, it warns once.

    With ``verbose=1`` it prints how many steps are random.
    """

    # Gradient steps before this training
    _n_updates_at_start: int = 0
    # The warning of this training, which is not repeated at its end
    _has_warned: bool = False
    # Whether this training counts its steps from those before it, and may be followed by others
    _continues: bool = False
    _has_said_not_yet: bool = False

    @contextmanager
    def _expecting_gradient_steps(self) -> Iterator[None]:
        """Warn if the training within the context has ended by itself without a gradient step."""
        self._n_updates_at_start, self._has_warned = self._n_updates, False
        yield
        has_ended = self._num_timesteps_at_start < self._total_timesteps <= self.num_timesteps
        has_trained = self._n_updates > self._n_updates_at_start
        if self._trains_by_episode and has_ended and not has_trained and not self._has_warned:
            self._warn_of_no_gradient_step(self.num_timesteps)

    def _announce_warm_up(self, total_timesteps: int, continues: bool) -> None:
        """Print how many steps are random, and warn if a training to ``total_timesteps`` will take no gradient step."""
        self._continues = continues
        self._has_said_not_yet &= continues
        if self.num_timesteps < total_timesteps:
            self._print_warm_up(total_timesteps)
            last_timestep = self._last_timestep(total_timesteps)
            if last_timestep is not None:
                self._warn_of_no_gradient_step(last_timestep, " at the latest" if self._trains_by_episode else "")

    def _last_timestep(self, total_timesteps: int) -> int | None:
        """Return the largest environment step at which the last rollout may end; None if no episode has a limit."""
        assert isinstance(self.train_freq, TrainFreq)
        if self._trains_by_episode:
            # SB3 admits one environment only. The last rollout begins before the last step, and has whole episodes.
            limit = _longest_episode(self.env)
            return None if limit is None else total_timesteps - 1 + self.train_freq.frequency * limit
        steps_per_rollout = self.train_freq.frequency * self.n_envs
        return self.num_timesteps + steps_per_rollout * math.ceil((total_timesteps - self.num_timesteps) / steps_per_rollout)

    def _learning_starts_of_agents(self) -> list[int]:
        """Return the random steps of each agent that the environments are divided among: here of one agent."""
        return [self.learning_starts]

    def _print_warm_up(self, total_timesteps: int) -> None:
        starts = self._learning_starts_of_agents()
        n_done, n_total = self.num_timesteps // len(starts), math.ceil(total_timesteps / len(starts))
        n_random = [max(min(start, n_total) - n_done, 0) for start in starts]
        if self.verbose >= 1 and max(n_random) > 0:
            n_steps = n_total - n_done
            is_most = 2 * max(n_random) > n_steps and not self._continues
            advice = " That is more than half: a smaller `learning_starts` trains more." if is_most else ""
            print(
                f"Actions are random in the next {_range_in_words(n_random)} of {n_steps:,} environment steps"
                f"{self._of_each_agent} (learning_starts={_range_in_words(starts, '')}), without gradient steps.{advice}"
            )

    @property
    def _of_each_agent(self) -> str:
        return " of each agent" if len(self._learning_starts_of_agents()) > 1 else ""

    @property
    def _trains_by_episode(self) -> bool:
        return isinstance(self.train_freq, TrainFreq) and self.train_freq.unit is TrainFrequencyUnit.EPISODE

    def _warn_of_no_gradient_step(self, last_timestep: int, certainty: str = "") -> None:
        """Warn if the training ends at an environment step at which no gradient step has been due, or none of some agent."""
        starts = self._learning_starts_of_agents()
        # The numbers of one agent, as the arguments are
        last_timestep //= len(starts)
        # SB3 trains after a rollout that ends beyond `learning_starts`
        late = [agent for agent, start in enumerate(starts) if last_timestep <= start]
        if not late or self.gradient_steps == 0 or (self._continues and self._has_said_not_yet):
            return
        self._has_warned = True
        self._has_said_not_yet |= self._continues
        subject, whose = ("Nothing is learnt", "") if len(late) == len(starts) else (_nothing_is_learnt_by(late), "their ")
        beyond = _range_in_words([starts[agent] for agent in late], "")
        # A tenth of the steps, as the documentation advises
        remedy = f"Give more `total_timesteps`, or a smaller `learning_starts`, such as {last_timestep // 10}"
        if self._continues:
            # A smaller `learning_starts` would be right for this training, and too small for all of them together
            subject, remedy = f"{subject} yet", "Continue with `reset_num_timesteps=False` beyond that step. This is said once"
        elif self._n_updates > 0:
            remedy += ", or continue the training before this one with `reset_num_timesteps=False`"
        warnings.warn(
            f"{subject}: the training ends at environment step {last_timestep}{self._of_each_agent}{certainty}, and "
            f"{whose}gradient steps begin after step learning_starts={beyond}. {remedy}.",
            stacklevel=2,
        )

    def _excluded_save_params(self) -> list[str]:
        own = ["_n_updates_at_start", "_has_warned", "_continues", "_has_said_not_yet"]
        return [*super()._excluded_save_params(), *own]


def _range_in_words(numbers: Sequence[int], thousands: str = ",") -> str:
    """Return the smallest and the largest of some numbers as text, with a separator of thousands."""
    low, high = (format(number, thousands) for number in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"


def _nothing_is_learnt_by(agents: Sequence[int]) -> str:
    """Return a clause that names the agents that learn nothing."""
    *others, last = map(str, agents)
    return f"Agents {', '.join(others)} and {last} learn nothing" if others else f"Agent {last} learns nothing"


def _longest_episode(env: VecEnv | None) -> int | None:
    """Return the limit of Gymnasium's ``TimeLimit``; None if an environment lacks it, or is in a process of its own."""
    base = innermost(env)
    if not isinstance(base, DummyVecEnv) or not all(base.env_is_wrapped(TimeLimit)):
        return None
    limits = [None if each.spec is None else each.spec.max_episode_steps for each in base.envs]
    known = [limit for limit in limits if limit is not None]
    return max(known) if len(known) == base.num_envs else None
