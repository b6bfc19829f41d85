"""Uncertain answers are trusted less: a Kalman filter on the offset and the angle. SI units.

What is known of the road is carried to the moment of an answer with the car's own motion, and the
answer corrects it. An answer of ordinary standard deviation counts in full; beyond that the gain
falls with its variance. An answer without a standard deviation is taken as it is.

Ordinary answers are not filtered although a filter with their variances brings the offset 30 %
nearer to the truth. It makes the drive worse (0.9881 a step on g-track-3 in place of 0.9894): the
angle that a network reads from an image turns into a bend before the car is there. Its error
correlates by -0.76 with the change of the curvature over the next 0.4 s, and a controller without
preview is better off with it. As it is, drives on ordinary images keep their scores (0.9894), and a
camera that fails for 15 % of the time, half a second each, no longer throws the car off the road:
none of three drives on g-track-3 (72 km/h) instead of all three. In `town` (50 km/h) it helps
little: 0.956 a step in place of 0.951.
"""

from dataclasses import dataclass, replace

from controllers.perception import Perceived

ORDINARY_M, ORDINARY_RAD = 0.1, 0.03
"""Standard deviations up to which an answer counts in full: those of 95 to 98 % of the test frames
with the shipped model, by light."""
UNFAMILIAR_SCALE = 3.0
"""The standard deviation of an answer that is out of distribution counts this many times."""
OFFSET_NOISE_M, ANGLE_NOISE_RAD = 0.01, 0.01
"""Process noise a control step: standard deviations of what the car's motion does not tell, such as
the curvature of the road."""
TRUSTED_GAIN = 0.1
"""An answer with a lower gain on the offset counts as one that did not come."""


@dataclass
class Trust:
    """The variances of what is known of the road after the last answer."""

    offset_m2: float = 0.0
    angle_rad2: float = 0.0
    untrusted_steps: int = 0
    """Control steps since the last answer that was trusted, at the moment of the last one."""

    def correct(
        self, known: Perceived | None, answer: Perceived, steps: int, moved_m: float
    ) -> Perceived:
        """`known`, carried over `steps` control steps and `moved_m` to the moment of `answer`, as
        it is after the answer; None for known: nothing is."""
        if answer.offset_std_m is None or answer.angle_std_rad is None:
            return answer
        offset_std, angle_std = answer.offset_std_m, answer.angle_std_rad
        if answer.out_of_distribution:
            offset_std, angle_std = UNFAMILIAR_SCALE * offset_std, UNFAMILIAR_SCALE * angle_std
        if known is None or known.to_lane_centre is None or answer.to_lane_centre is None:
            self.offset_m2, self.angle_rad2, self.untrusted_steps = offset_std**2, angle_std**2, 0
            return answer
        # An error of the angle has become one of the offset on the way.
        offset_m2 = self.offset_m2 + moved_m**2 * self.angle_rad2 + steps * OFFSET_NOISE_M**2
        angle_rad2 = self.angle_rad2 + steps * ANGLE_NOISE_RAD**2
        gain = offset_m2 / (offset_m2 + max(offset_std**2 - ORDINARY_M**2, 0.0))
        angle_gain = angle_rad2 / (angle_rad2 + max(angle_std**2 - ORDINARY_RAD**2, 0.0))
        self.offset_m2 = _joseph(offset_m2, gain, offset_std)
        self.angle_rad2 = _joseph(angle_rad2, angle_gain, angle_std)
        self.untrusted_steps = 0 if gain >= TRUSTED_GAIN else self.untrusted_steps + steps
        if gain == angle_gain == 1.0:
            return answer
        return replace(
            answer,
            to_lane_centre=(1.0 - gain) * known.to_lane_centre + gain * answer.to_lane_centre,
            angle=(1.0 - angle_gain) * known.angle + angle_gain * answer.angle,
        )


def _joseph(variance: float, gain: float, std: float) -> float:
    """The variance after a correction, for any gain (Joseph's form)."""
    return (1.0 - gain) ** 2 * variance + gain**2 * std**2
