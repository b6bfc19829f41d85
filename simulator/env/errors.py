"""Errors of the environments that Gymnasium has classes for."""

import gymnasium as gym

from trackfeatures.errors import UserError


class ResetNeeded(UserError, gym.error.ResetNeeded):
    """`step` was called before `reset` or after the end of an episode."""


class NotCopyable(UserError, TypeError):
    """An environment cannot be copied or pickled."""
