"""How well each set of cameras can locate reach's goal, given exact pixel positions of ten goals.

    python results/analysis/reach_views.py --output=results/analysis/reach_views.json

For each set of cameras, a linear regression maps the goal's pixel coordinates in every view to its position. It is
fitted on the ten seen variations and predicts the goals of the forty unseen ones. A single view lacks the depth along
its line of sight, and ten goals are too few to learn it. Takes seconds.

Reach succeeds when the point between the fingers comes within 5 cm of the goal. The expert steers the *hand* to the
goal, and that point is 4.5 cm below the hand. So the demonstrations end 5 mm inside the sphere's lower edge. Here an
imitating policy moves the hand on a straight line to the predicted goal, and succeeds if the fingers enter the sphere.
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


def project(simulation: Simulation, camera: str, points: np.ndarray) -> np.ndarray:
    """Return pixel coordinates (N, 2) of points (N, 3), relative to the centre of a 64x64 image."""
    pose = simulation.data.camera(camera)
    field_of_view = np.radians(simulation.model.camera(camera).fovy[0])
    in_camera = (points - pose.xpos) @ pose.xmat.reshape(3, 3)  # (N, 3), the camera looks along -z
    return in_camera[:, :2] / -in_camera[:, 2:] * (IMAGE_SIZE / 2) / np.tan(field_of_view / 2)


def predict_goals(inputs: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Predict the unseen goals (40, 3) by linear regression from the seen variations."""
    seen, unseen = slice(NUM_SEEN_VARIATIONS), slice(NUM_SEEN_VARIATIONS, None)
    return LinearRegression().fit(inputs[seen], goals[seen]).predict(inputs[unseen])


def succeeds(aims: np.ndarray, goals: np.ndarray, hand: np.ndarray, fingers: np.ndarray) -> np.ndarray:
    """Say whether the fingers come within 5 cm of the goals while the hand moves straight to its aim.

    Args:
        aims: End points of the hand, (N, 3).
        goals: Positions of the goals, (N, 3).
        hand: Start of the hand, (3,).
        fingers: Point between the fingers relative to the hand, (3,).

    Returns:
        (N,) bool.
    """
    way = aims - hand  # (N, 3)
    to_goal = goals - fingers - hand  # (N, 3)
    share = (way * to_goal).sum(1) / (way * way).sum(1)  # of the way, where it is nearest to the goal
    nearest = way * share.clip(0, 1)[:, None]
    return np.linalg.norm(nearest - to_goal, axis=1) <= SUCCESS_RADIUS


def main() -> None:
    """Measure all views, print the table and write it as JSON."""
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
        """Average error and success over draws of the inputs, (50, n) each."""
        aims = [predict_goals(inputs, goals) for inputs in draws]
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
        exact = np.hstack([project(simulation, view, goals) for view in views])  # (50, 2·views)
        noisy = [exact + rng.normal(0, PIXEL_NOISE, exact.shape) for _ in range(NOISE_DRAWS)]
        rows[" + ".join(views)] = {"exact": summary([exact]), "half_pixel_noise": summary(noisy)}
    for name, row in rows.items():
        print(f"{name:36s}", *(f"{kind}: {values}" for kind, values in row.items()))
    print(f"fingers relative to the hand, cm: {np.round(100 * fingers, 2)}")
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({"rows": rows, "provenance": provenance()}, indent=2) + "\n")


if __name__ == "__main__":
    main()
