"""The rate of the physics, and a check of control rates."""

from trackfeatures.errors import UserError

PHYSICS_HZ = 200


def check_frequency(frequency_hz: int) -> None:
    """Raises UserError unless a control step at `frequency_hz` (Hz) is a whole number of physics
    steps."""
    if not 1 <= frequency_hz <= PHYSICS_HZ or PHYSICS_HZ % frequency_hz:  # also true for NaN
        raise UserError(
            f"a control frequency of {frequency_hz} Hz does not divide the physics' "
            f"{PHYSICS_HZ} Hz; choose for example 10, 20, 40 or 50"
        )
