"""Handles a client's requests: steps the world and writes the answer into a record.

This module does not depend on the shared memory. A bad request is answered with an error code and a
message, and leaves the state of the car unchanged.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simulator.env.reward import ending, step_reward
from simulator.env.start import check_start
from simulator.link.layout import ERROR_BYTES, Refusal, Request
from simulator.link.message import read_command, write_ending, write_features, write_state
from simulator.sensors.standard import read_range, read_track_range
from simulator.vehicle.state import CarState, Command
from simulator.world.errors import ContactsUnavailable
from simulator.world.world import World
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from simulator.camera import Camera

_NOT_OPEN = "there is no episode yet; ask for a reset first"


class Simulation:
    """Answers the requests to one world. `record` is the STATE record for the answers, `image` (n,)
    uint8 the memory for the camera image.

    The n-th episode (n from 1) has the seed `seed` + n if its reset request gives no seed.
    """

    def __init__(
        self,
        world: World,
        record: Any,
        image: NDArray[np.uint8],
        *,
        seed: int = 0,
        camera: "Camera | None" = None,
    ) -> None:
        self._world, self._record, self._image = world, record, image
        self._seed, self._camera = seed, camera
        self._open, self._why_closed = False, _NOT_OPEN
        self._held = Command()
        self.steps, self.refused = 0, 0

    @property
    def episodes(self) -> int:
        return int(self._record["episode"])

    @property
    def position_text(self) -> str:
        """Step and episode as text for messages."""
        return f"at step {int(self._record['step'])} of episode {self.episodes}"

    @property
    def running(self) -> bool:
        """Whether there is an episode that has not ended."""
        return self._open and not self._record["ended"]

    def end_episode(self) -> None:
        """End the episode because its client has left."""
        self._open, self._why_closed = False, _NOT_OPEN

    def answer(self, request: Any) -> None:
        """Execute the COMMAND record `request` and write the answer into the STATE record."""
        record = self._record
        record["error"], record["error_text"] = Refusal.NONE, b""
        asked = int(request["request"])
        if asked == Request.RESET:
            self._reset(request)
        elif asked == Request.STEP:
            self._step(read_command(request))
        elif asked not in (Request.LEAVE, Request.QUIT):
            known = ", ".join(f"{kind.value} {kind.name}" for kind in Request)
            self._refuse(Refusal.UNKNOWN_REQUEST, f"the request is {asked}; there are {known}")

    def reject(self, text: str) -> None:
        """Write the refusal of a command with a wrong checksum into the STATE record; `text` is the
        error message."""
        self._refuse(Refusal.BAD_CHECKSUM, text)

    def advance(self) -> None:
        """Step the world with the last command, without a request (real-time mode).

        If contacts cannot be computed, the episode ends, and steps are refused until the next
        reset.
        """
        try:
            state = self._world.step(self._held)
        except ContactsUnavailable as error:
            self._open, self._why_closed = False, str(error)
        else:
            self._measure(state, stepped=True)

    def _reset(self, request: Any) -> None:
        """Start an episode, or refuse a bad start."""
        episode = self.episodes + 1
        seed, s = int(request["seed"]), float(request["start_s"])
        chosen = seed if seed >= 0 else self._seed + episode
        try:
            asked = {
                "s": None if math.isnan(s) else s,
                "to_middle": request["start_to_middle"],
                "angle": request["start_angle"],
                "speed": request["start_speed"],
            }
            state = self._world.reset(seed=chosen, **check_start(asked, self._world.road))
        except UserError as error:
            self._refuse(Refusal.BAD_RESET, str(error))
            return
        self._open, self._held = True, Command()
        for name in ("step", "late_steps", "score"):
            self._record[name] = 0
        self._record["episode"], self._record["seed"] = episode, chosen
        self._measure(state, stepped=False)

    def _step(self, command: Command) -> None:
        """Advance the world by one step with `command`, or refuse the command."""
        if not self._open:
            self._refuse(Refusal.NO_EPISODE, self._why_closed)
        elif self._record["ended"]:
            why = ending(self._world.state)
            self._refuse(
                Refusal.EPISODE_ENDED,
                f"the episode has ended ({why}) at step {int(self._record['step'])}; ask for a "
                "reset",
            )
        else:
            try:
                state = self._world.step(command)
            except ContactsUnavailable as error:
                self._open, self._why_closed = False, str(error)
                self._refuse(Refusal.NO_EPISODE, self._why_closed)
                return
            except UserError as error:
                self._refuse(Refusal.BAD_COMMAND, str(error))
                return
            self._held = command
            self._measure(state, stepped=True)

    def _measure(self, state: CarState, *, stepped: bool) -> None:
        """Write state, features, ranges, reward and image into the record. `stepped` is false after
        a reset; the reward is then 0."""
        record, world = self._record, self._world
        ended = ending(state)
        reward = 0.0
        if stepped:
            half_width = world.road.half_width
            reward = step_reward(state.angle, state.to_middle, half_width, ended is not None)
            record["step"] += 1
            self.steps += 1
        record["reward"] = reward
        record["score"] += reward
        write_state(record, state)
        write_ending(record, ended)
        write_features(record, world.features())
        record["ranges"] = read_track_range(world)
        # Without traffic both are equal, and computing the beams twice would be slow.
        record["ranges_traffic"] = read_range(world) if world.traffic.count else record["ranges"]
        if self._camera is not None:
            picture = self._camera.render(world.body_pose(), world.traffic.poses())
            self._image[: picture.size] = picture.ravel()

    def _refuse(self, code: Refusal, text: str) -> None:
        self.refused += 1
        self._record["error"] = code
        self._record["error_text"] = text.encode()[: ERROR_BYTES - 1]
