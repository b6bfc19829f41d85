"""What can be wrong with a recording or a dataset folder."""

from trackfeatures.errors import UserError


class DatasetError(UserError):
    """A dataset folder or one of its rounds cannot be read, or must not be used as it is."""
