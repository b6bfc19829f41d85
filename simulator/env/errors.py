"""Errors of the environments that are also errors of Gymnasium or Python."""

import gymnasium as gym

from trackfeatures.errors import UserError


class ResetNeeded(UserError, gym.error.ResetNeeded):
    """Raised if `step` is called before `reset` or after the end of an episode."""


class NotCopyable(UserError, TypeError):
    """Raised if an environment is copied or pickled."""
