"""Draws the moving picture of the documentation: `python docs/make_images.py` writes `drive.webp`.

A drive on "coast" with a lane change; the true markings and features are drawn over the images.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import simulator.env  # noqa: F401  (registers the names)
from simulator.camera import overlay
from simulator.camera.core.camera import DRIVER_CAMERA, Camera, open_camera
from trackfeatures import RoadClass

IMAGES = Path(__file__).parent / "images"
WIDTH, HEIGHT, STEPS, EVERY = 480, 360, 200, 2
LANE_M = 2.0  # from the middle of a two-lane road to the middle of a lane
COLOURS = ((255, 210, 0), (0, 230, 255), (255, 90, 90))


def drive() -> list[Image.Image]:
    """The frames of a drive, half as many as control steps."""
    env: Any = gymnasium.make("driverview/LateralControl-v0", track="coast", lanes=2, traffic=3)
    _, info = env.reset(seed=4, options={"s": 250.0, "to_middle": -LANE_M, "speed": 14.0})
    world = env.unwrapped.world
    parameters = replace(DRIVER_CAMERA, width=WIDTH, height=HEIGHT)
    camera = open_camera(world.road, parameters, light="clear", seed=5)
    frames = []
    for step in range(STEPS):
        share = np.clip((step - 60) / 60, 0.0, 1.0)
        target = -LANE_M + 2.0 * LANE_M * share * share * (3.0 - 2.0 * share)
        steer = 2.0 * info["angle"] - 0.15 * (info["to_middle"] - target)
        _, _, terminated, _, info = env.step([float(np.clip(steer, -1.0, 1.0))])
        assert not terminated, info["ended"]
        if step % EVERY == 0:
            frames.append(picture(camera, world, info))
    env.close()
    return frames


def picture(camera: Camera, world: Any, info: dict[str, Any]) -> Image.Image:
    """One frame with the true markings and a line of features."""
    pose = overlay.pose_of_state(world.state)
    image = camera.render(pose, world.traffic.poses())
    for k, line in enumerate(overlay.marking_polylines(camera, world.road, world.state)):
        image = overlay.draw(image, [line], COLOURS[k % len(COLOURS)])
    features = info["features"]
    names = [
        f"{name} {features[name]:+.2f}" for name in ("ml", "mr", "l", "m", "r") if name in features
    ]
    drawn = Image.fromarray(image)
    write(drawn, "  ".join(names) + " m", (10, HEIGHT - 34))
    ahead = RoadClass(features["heading"]).name.lower()
    write(drawn, f"angle {features['angle']:+.3f} rad   road ahead: {ahead}", (10, HEIGHT - 12))
    return drawn


def write(image: Image.Image, text: str, place: tuple[int, int]) -> None:
    """White text with a dark edge."""
    font = ImageFont.load_default(16)
    ImageDraw.Draw(image).text(
        place, text, "white", font, stroke_width=2, stroke_fill="black", anchor="lb"
    )


if __name__ == "__main__":
    frames = drive()
    frames[0].save(
        IMAGES / "drive.webp",
        save_all=True,
        append_images=frames[1:],
        duration=50 * EVERY,
        loop=0,
        quality=50,
        method=6,
    )
