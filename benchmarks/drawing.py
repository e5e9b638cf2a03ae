"""Time saved by drawing the robot without its smallest details, and how the images change.

    python -m benchmarks.drawing --output=results/benchmarks/drawing.json

Draws states of random actions with all of the robot's triangles and with simplified meshes, in turns. Times are medians
in ms. For comparison, it also measures how much an image differs from the image one step earlier.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.measure import write_rows
from lerobot_wm.envs import rendering
from lerobot_wm.envs.rendering import Renderer, RenderKey
from lerobot_wm.envs.simulation import Simulation

# Size and camera.
VIEWS = [(64, "corner2"), (64, "hand_top"), (64, "hand_side"), (128, "corner2"), (480, "corner2")]
TASKS = ("reach-v3", "door-open-v3")
VARIATIONS, STEPS = 4, 50
ACTION_STEPS = 10  # steps for which one action is repeated
VISIBLE = 16  # of 255; pixels that change by more are counted


def make_detailed_renderer(key: RenderKey, model: Any) -> Renderer:
    """Make a renderer that does not simplify the robot."""
    with patch.object(rendering, "simplify_robot"):
        return rendering._gl_thread.submit(Renderer, key, model).result()


def draw(renderer: Renderer, simulation: Simulation) -> tuple[np.ndarray, float]:
    """Return an image (H, W, 3) as signed integers, and the milliseconds it took."""
    started = time.perf_counter()
    image = renderer.render(simulation.model, simulation.data)
    return image.astype(int), 1e3 * (time.perf_counter() - started)


def compare(task: str, camera: str, size: int) -> dict[str, Any]:
    """Measure one row: times, differences between the two images, and between one step and the next."""
    simulation = Simulation(task)
    key = RenderKey(task, camera, size, fast=True)
    sides = [make_detailed_renderer(key, simulation.model), Renderer.acquire(key, simulation.model)]
    rng = np.random.default_rng(0)
    times: list[list[float]] = [[], []]
    detail, motion, visible = [], [], []
    for variation in range(VARIATIONS):
        simulation.reset(variation)
        before, _ = draw(sides[0], simulation)
        for step in range(STEPS):
            if step % ACTION_STEPS == 0:
                action = rng.uniform(-1, 1, 4)
            simulation.step(action)
            pictures = [draw(side, simulation) for side in sides]
            for side, (_, milliseconds) in zip(times, pictures, strict=True):
                side.append(milliseconds)
            full, simple = (image for image, _ in pictures)
            detail.append(np.abs(full - simple).mean())
            visible.append((np.abs(full - simple).max(-1) > VISIBLE).mean())
            motion.append(np.abs(full - before).mean())
            before = full
    Renderer.release(key)
    ms_whole, ms_simplified = map(statistics.median, times)
    return {
        "task": task,
        "camera": camera,
        "size": size,
        "ms_whole": ms_whole,
        "ms_simplified": ms_simplified,
        "ratio": ms_whole / ms_simplified,
        "mean_difference_of_255": float(np.mean(detail)),
        "share_of_pixels_changed": float(np.mean(visible)),
        "mean_difference_to_the_step_before_of_255": float(np.mean(motion)),
    }


def main() -> None:
    """Measure every view and task."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, help="JSON file to write")
    output = parser.parse_args().output
    rows = [compare(task, camera, size) for size, camera in VIEWS for task in TASKS]
    write_rows("benchmarks.drawing", rows, output)


if __name__ == "__main__":
    main()
