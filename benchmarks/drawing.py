"""What it saves to draw the robot without details of a fifth of a pixel, and what it changes in the picture.

    python -m benchmarks.drawing --output=results/benchmarks/drawing.json

Each image is drawn with all of the robot's triangles and without, by turns, in states that random actions lead to.
Milliseconds are medians. As a yardstick stands how much an image differs from that of the step before.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from lerobot_wm.envs import rendering
from lerobot_wm.envs.rendering import Renderer, RenderKey
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.records import provenance

VIEWS = [
    (64, "corner2"),
    (64, "hand_top"),
    (64, "hand_side"),
    (128, "corner2"),
    (480, "corner2"),
]  # size, camera
TASKS = ("reach-v3", "door-open-v3")
VARIATIONS, STEPS = 4, 50
HELD = 10  # steps that an action is held for
VISIBLE = 16  # of 255: a pixel that changes by more is counted


def whole(key: RenderKey, model: Any) -> Renderer:
    """A renderer that merges no vertices."""
    with patch.object(rendering, "simplify_robot"):
        return rendering._gl_thread.submit(Renderer, key, model).result()


def drawn(renderer: Renderer, simulation: Simulation) -> tuple[np.ndarray, float]:
    """An image (H, W, 3) as integers that may be subtracted, and the milliseconds it took."""
    started = time.perf_counter()
    image = renderer.render(simulation.model, simulation.data)
    return image.astype(int), 1e3 * (time.perf_counter() - started)


def compare(task: str, camera: str, size: int) -> dict[str, Any]:
    """One row: times, and differences between the two pictures and between one step and the next."""
    simulation = Simulation(task)
    key = RenderKey(task, camera, size, fast=True)
    sides = [whole(key, simulation.model), Renderer.acquire(key, simulation.model)]
    rng = np.random.default_rng(0)
    times: list[list[float]] = [[], []]
    detail, motion, visible = [], [], []
    for variation in range(VARIATIONS):
        simulation.reset(variation)
        before, _ = drawn(sides[0], simulation)
        for step in range(STEPS):
            if step % HELD == 0:
                action = rng.uniform(-1, 1, 4)
            simulation.step(action)
            pictures = [drawn(side, simulation) for side in sides]
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
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    output: Path = parser.parse_args().output
    rows = [compare(task, camera, size) for size, camera in VIEWS for task in TASKS]
    source = {**provenance(), "command": f"python -m benchmarks.drawing --output={output}"}
    output.write_text(json.dumps({"provenance": source, "rows": rows}, indent=2) + "\n")
    for row in rows:
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in row.values()), sep="\t")


if __name__ == "__main__":
    main()
