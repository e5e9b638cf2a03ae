"""How well cameras can tell where reach's goal is, whatever the model: exact pixel positions, ten goals to learn from.

    python scripts/reach_views.py --output=results/analysis/reach_views.json        (seconds)

For each set of cameras, the goal's exact pixel coordinates in every view are the input of a linear regression that
is fitted on the ten seen variations and asked for the goals of the forty unseen ones. With one view the depth along
its line of sight is missing, and ten goals cannot make up for it.

Reach succeeds when the point between the fingers comes within 5 cm of the goal. The expert steers the *hand* to the
goal, and that point hangs 4.5 cm below the hand: demonstrations end 5 mm inside the sphere's lower edge. A policy that
imitates them succeeds if its way, taken as the straight line from the hand's start to where it believes the goal is,
enters the sphere.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from sklearn.linear_model import LinearRegression

from lerobot_wm.constants import IMAGE_SIZE, NUM_SEEN_VARIATIONS, NUM_VARIATIONS
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.variations import rand_vec
from lerobot_wm.records import provenance

TASK = "reach-v3"
SUCCESS_RADIUS = 0.05  # metres, Meta-World's own
PIXEL_NOISE = 0.5  # standard deviation of a detector that is off by half a pixel
NOISE_DRAWS = 200
VIEWS = (
    ("corner2",),
    ("topview",),
    ("corner2", "topview"),
    ("corner2", "corner"),
    ("corner2", "behindGripper"),
)


def pixels(simulation: Simulation, camera: str, points: np.ndarray) -> np.ndarray:
    """Pixel coordinates (N, 2) of points (N, 3), relative to the centre of a 64x64 image."""
    pose = simulation.data.camera(camera)
    field_of_view = np.radians(simulation.model.camera(camera).fovy[0])
    in_camera = (points - pose.xpos) @ pose.xmat.reshape(3, 3)  # (N, 3), the camera looks along -z
    return in_camera[:, :2] / -in_camera[:, 2:] * (IMAGE_SIZE / 2) / np.tan(field_of_view / 2)


def predicted_goals(inputs: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Goals (40, 3) that a linear regression on the seen variations predicts for the unseen ones."""
    seen, unseen = slice(NUM_SEEN_VARIATIONS), slice(NUM_SEEN_VARIATIONS, None)
    return LinearRegression().fit(inputs[seen], goals[seen]).predict(inputs[unseen])


def succeeds(aims: np.ndarray, goals: np.ndarray, hand: np.ndarray, fingers: np.ndarray) -> np.ndarray:
    """Whether fingers that move on straight lines, until the hand is at its aim, come within 5 cm of the goals.

    Args:
        aims: Where the hand goes, (N, 3).
        goals: (N, 3).
        hand: Where it starts, (3,).
        fingers: Position of the point between the fingers relative to the hand, (3,).

    Returns:
        (N,) bool.
    """
    way = aims - hand  # (N, 3)
    to_goal = goals - fingers - hand  # (N, 3)
    share = (way * to_goal).sum(1) / (way * way).sum(1)  # of the way, at its point nearest to the goal
    nearest = way * share.clip(0, 1)[:, None]
    return np.linalg.norm(nearest - to_goal, axis=1) <= SUCCESS_RADIUS


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    output = parser.parse_args().output
    register_third_party_plugins()
    simulation = Simulation(TASK)
    hand = simulation.reset(0)[:3]
    fingers = simulation._env.tcp_center - hand  # Meta-World has no public name for it
    goals = np.array([rand_vec(TASK, k)[3:] for k in range(NUM_VARIATIONS)])  # (50, 3)
    unseen = goals[NUM_SEEN_VARIATIONS:]  # (40, 3)

    def summary(draws: list[np.ndarray]) -> dict[str, float]:
        """Mean error of the predicted goals and share of successes over draws of the inputs, (50, n) each."""
        aims = [predicted_goals(inputs, goals) for inputs in draws]
        distances = [np.linalg.norm(aim - unseen, axis=1) for aim in aims]
        reached = [succeeds(aim, unseen, hand, fingers) for aim in aims]
        return {
            "mean_error_cm": round(100 * float(np.mean(distances)), 2),
            "success": round(float(np.mean(reached)), 3),
        }

    rng = np.random.default_rng(0)
    rows = {
        "the goal itself": {"exact": summary([goals])},
        "no image (mean of the seen goals)": {"exact": summary([np.zeros((len(goals), 1))])},
    }
    for views in VIEWS:
        exact = np.hstack([pixels(simulation, view, goals) for view in views])  # (50, 2·views)
        noisy = [exact + rng.normal(0, PIXEL_NOISE, exact.shape) for _ in range(NOISE_DRAWS)]
        rows[" + ".join(views)] = {"exact": summary([exact]), "half_pixel_noise": summary(noisy)}
    for name, row in rows.items():
        print(f"{name:36s}", *(f"{kind}: {values}" for kind, values in row.items()))
    print(f"fingers relative to the hand, cm: {np.round(100 * fingers, 2)}")
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({"rows": rows, "provenance": provenance()}, indent=2) + "\n")


if __name__ == "__main__":
    main()
