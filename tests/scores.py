"""A score that keeps the actions that it was asked for, and a loop's first samples, for the tests of selectors."""

import math


class Seen:
    """A score that keeps the actions that it was asked for, and rates one coordinate, or what it is given."""

    def __init__(self, score=lambda actions: -actions.square().sum(dim=2)):
        self.score, self.actions = score, []

    def __call__(self, actions):
        self.actions.append(actions.clone())
        return self.score(actions)


def first_pairs(draws, proposal, n_around, std):
    """The first samples of one state of one dimension, with their actions: the proposal, those around it, the prior's."""
    centre = math.atanh(max(min(proposal, 0.99), -0.99))
    pairs = [(centre, proposal)]
    for index, draw in enumerate(draws[1:]):
        sample = centre + std * draw if index < n_around else draw
        pairs.append((sample, math.tanh(sample)))
    return pairs
