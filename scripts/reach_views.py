"""How well cameras can tell where reach's goal is, whatever the model: exact pixel positions, ten goals to learn from.

    python scripts/reach_views.py --output=results/analysis/reach_views.json        (seconds)

For each set of cameras, the goal's exact pixel coordinates in every view are the input of a linear regression that
is fitted on the ten seen variations and asked for the goals of the forty unseen ones. Success in reach means ending
within 5 cm. With one view the depth along its line of sight is missing, and ten goals cannot make up for it.
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
from lerobot_wm.report.provenance import provenance

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


def errors(inputs: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Distances (m) of the predicted from the true goals of the unseen variations, (40,)."""
    seen, unseen = slice(NUM_SEEN_VARIATIONS), slice(NUM_SEEN_VARIATIONS, None)
    predicted = LinearRegression().fit(inputs[seen], goals[seen]).predict(inputs[unseen])
    return np.linalg.norm(predicted - goals[unseen], axis=1)


def summary(distances: np.ndarray) -> dict[str, float]:
    """Mean error and the share of goals that would be reached."""
    return {
        "mean_error_cm": round(100 * float(distances.mean()), 2),
        "within_5_cm": round(float((distances < SUCCESS_RADIUS).mean()), 3),
    }


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    output = parser.parse_args().output
    register_third_party_plugins()
    simulation = Simulation(TASK)
    simulation.reset(0)
    goals = np.array([rand_vec(TASK, k)[3:] for k in range(NUM_VARIATIONS)])  # (50, 3)
    rng = np.random.default_rng(0)
    rows = {"no image (mean of the seen goals)": {"exact": summary(errors(np.zeros((len(goals), 1)), goals))}}
    for views in VIEWS:
        exact = np.hstack([pixels(simulation, view, goals) for view in views])  # (50, 2·views)
        noisy = [errors(exact + rng.normal(0, PIXEL_NOISE, exact.shape), goals) for _ in range(NOISE_DRAWS)]
        rows[" + ".join(views)] = {
            "exact": summary(errors(exact, goals)),
            "half_pixel_noise": summary(np.concatenate(noisy)),
        }
    for name, row in rows.items():
        print(f"{name:36s}", *(f"{kind}: {values}" for kind, values in row.items()))
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({"rows": rows, "provenance": provenance()}, indent=2) + "\n")


if __name__ == "__main__":
    main()
