"""The delay of a perception, estimated from the car's own yaw rate. SI units."""

import numpy as np
from numpy.typing import NDArray

from trackfeatures.errors import UserError

Vector = NDArray[np.float64]

MAX_DELAY = 4
"""Longest delay in control steps: 0.2 s at 20 Hz."""
SPANS = (1, 4)
"""Control steps over which second differences are taken: short ones are exact without noise, long
ones contain more of the motion and no more of the noise."""
WINDOW, FEWEST = 200, 20
"""Largest and least number of control steps that are compared."""
SURE = 3.5
"""Number of standard errors by which a delay must explain the measurements better than any
other."""


class DelayEstimate:
    """By how many control steps the perceived heading lags behind the measured yaw rate.

    The heading error changes by theta' = r - kappa vx. Its second differences minus those of the
    integrated yaw rate contain the noise, the change of the road's curvature kappa, which is small,
    and for a wrong delay the motion of the car. Their squares are compared for the delays of 0 to
    `MAX_DELAY` steps over the last `WINDOW` steps.

    `known_s`: the delay, s, if it is known; then nothing is estimated. Raises UserError if it is
    longer than `MAX_DELAY` steps.
    """

    def __init__(self, dt: float, known_s: float | None = None) -> None:
        self._dt = dt
        self.steps = 0 if known_s is None else round(known_s / dt)
        """The delay that is assumed: 0 until the measurements contradict it."""
        if not 0 <= self.steps <= MAX_DELAY:
            raise UserError(
                f"the perception's delay is {known_s:g} s; lqr-kalman and mpc-kalman take 0 to "
                f"{MAX_DELAY * dt:g} s"
            )
        self.is_known = known_s is not None
        """Whether it was given, or the measurements ever separated it from all others."""
        self._is_given = self.is_known
        self._rates = np.zeros(MAX_DELAY + 2)
        self._turned = np.zeros(MAX_DELAY + 1)  # rad, integrals of the yaw rate of so long ago
        self._residuals = np.zeros((2 * max(SPANS) + 1, MAX_DELAY + 1))
        self._squares = np.zeros((len(SPANS), WINDOW, MAX_DELAY + 1))
        self._count = -(2 * max(SPANS) + MAX_DELAY)

    def update(self, theta: float, yaw_rate: float) -> bool:
        """One control step with the perceived heading error (rad) and the yaw rate (rad/s) of now.

        Returns whether `steps` changed.
        """
        if self._is_given:
            return False
        self._rates[1:] = self._rates[:-1].copy()
        self._rates[0] = yaw_rate
        self._turned += 0.5 * self._dt * (self._rates[1:] + self._rates[:-1])
        self._residuals[1:] = self._residuals[:-1].copy()
        self._residuals[0] = theta - self._turned
        self._count += 1
        if self._count <= 0:
            return False
        for squares, span in zip(self._squares, SPANS, strict=True):
            second = self._residuals[0] - 2.0 * self._residuals[span] + self._residuals[2 * span]
            squares[self._count % WINDOW] = second**2
        before = self.steps
        if self._count >= FEWEST:
            self._decide()
        return self.steps != before

    def _decide(self) -> None:
        for squares, span in zip(self._squares, SPANS, strict=True):
            compared = squares[: min(self._count, WINDOW)]
            best = int(compared.mean(axis=0).argmin())
            # Neighbouring second differences over several steps have measurements in common.
            independent = len(compared) / span
            gains = compared - compared[:, [best]]
            error = gains.std(axis=0) / independent**0.5
            sure = gains.mean(axis=0) > SURE * error
            if best != self.steps and sure[self.steps]:
                self.steps, self.is_known = best, True
            elif best == self.steps and np.delete(sure, best).all():
                self.is_known = True
