"""Linear probes: what can be read from the latents on variations that the probe was not fitted to."""

import logging
from dataclasses import dataclass

import numpy as np
import pandas as pd
from sklearn.decomposition import PCA
from sklearn.dummy import DummyClassifier, DummyRegressor
from sklearn.linear_model import LogisticRegression, Ridge
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import ENV_STATE_DIM, OBS_ENV_STATE, VARIATION
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import Filtered

logger = logging.getLogger(__name__)

LATENT, EMBEDDING, UNTRAINED, PIXELS = "latent s_t", "frame-only e_t", "untrained RSSM", "raw-pixel PCA"
# The probe that does not look at the image: the mean position, the most frequent task.
BLIND = "no image"
REPRESENTATIONS = (LATENT, EMBEDDING, UNTRAINED, PIXELS, BLIND)
MEAN_OF_TASKS = "mean of tasks"

# Meta-World's 39-dimensional state (m): hand and first object at its start, the goal at its end.
POSITIONS = {"object": slice(4, 7), "gripper": slice(0, 3), "goal": slice(36, 39)}
FRAMES_PER_EPISODE = 15
FOLDS = 5
# Ridge penalties, for standardised features and some hundred frames: wide enough that the best one for latents,
# embeddings and components each lies inside.
ALPHAS = tuple(np.logspace(-3, 5, 9))
_LOGISTIC_ITERATIONS = 1000
_CM = 100.0

# Rows to fit to and rows to test on.
Split = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Frames:
    """N frames drawn from episodes.

    Attributes:
        features: The representations that are compared, (N, ·) float64 each: float32 loses the smallest penalties.
        targets: What is read from them, (N, ·) by name; Meta-World's positions are in m.
        tasks: (N,) task strings.
        variations: (N,); frames are split by these, never one by one. Other datasets' episodes count as variations.
        to_fit: (N,) bool, the frames of the training data; None fits by cross-validation.
    """

    features: dict[str, np.ndarray]
    targets: dict[str, np.ndarray]
    tasks: np.ndarray
    variations: np.ndarray
    to_fit: np.ndarray | None


def probe_targets(episode: Episode) -> dict[str, Tensor]:
    """What probes read from the latent, (T, ·) by name.

    These are Meta-World's positions in m where `lerobot-wm collect` recorded them, elsewhere the observation's vectors.
    """
    state = episode.columns.get(OBS_ENV_STATE)
    if VARIATION in episode.columns and state is not None and state.shape[1] == ENV_STATE_DIM:
        return {name: state[:, place] for name, place in POSITIONS.items()}
    return {
        key: values.flatten(1) for key, values in episode.columns.items() if key.startswith("observation.")
    }


def variation_of(episode: Episode) -> int:
    """The episode's variation; elsewhere its index, as it is not known which episodes begin alike."""
    return int(episode.columns[VARIATION][0]) if VARIATION in episode.columns else episode.index


def start_positions(episode: Episode) -> tuple[float, ...]:
    """Object and goal at the first frame in Meta-World: equal to the bit for equal variations."""
    targets = probe_targets(episode)
    return tuple(x for name in ("object", "goal") for x in targets[name][0].tolist())


def draw_frames(
    episodes: list[Episode], filtered: list[Filtered], untrained: list[Filtered], n_fit: int, seed: int
) -> Frames:
    """Draw FRAMES_PER_EPISODE frames of each episode at random.

    There are as many principal components as the latent has dimensions (or as there are frames). They are fitted to the
    frames of the training data; without those to all frames, which favours them a little.

    Args:
        episodes: Episodes of the training data first, then held-out ones.
        filtered: Their closed loops.
        untrained: Their closed loops under an untrained world model.
        n_fit: How many of the episodes are training data; 0 fits probes by cross-validation.
        seed: Seed of the draw and of the principal components.
    """
    rng = np.random.default_rng(seed)
    picks = [
        np.sort(rng.choice(len(episode), min(FRAMES_PER_EPISODE, len(episode)), replace=False))
        for episode in episodes
    ]
    counts = [len(pick) for pick in picks]

    def per_frame(values: list) -> np.ndarray:
        return np.repeat(values, counts)

    def gather(arrays: list) -> np.ndarray:
        return np.concatenate([array[pick] for array, pick in zip(arrays, picks, strict=True)])

    to_fit = per_frame([i < n_fit for i in range(len(episodes))])
    pixels = np.concatenate(
        [
            episode.images(pick.tolist()).flatten(1).numpy()
            for episode, pick in zip(episodes, picks, strict=True)
        ]
    )  # (N, C·64·64)
    latents = gather([loop.latents.numpy() for loop in filtered])  # (N, D+S)
    fitted_to = pixels[to_fit] if n_fit else pixels
    pca = PCA(min(latents.shape[1], *fitted_to.shape), svd_solver="randomized", random_state=seed)
    pca.fit(fitted_to)
    targets = [probe_targets(episode) for episode in episodes]
    features = {
        LATENT: latents,
        EMBEDDING: gather([loop.embeds.numpy() for loop in filtered]),  # (N, E)
        UNTRAINED: gather([loop.latents.numpy() for loop in untrained]),  # (N, D+S)
        PIXELS: _scores(pca, pixels),
        BLIND: np.zeros((len(pixels), 1)),
    }
    return Frames(
        features={name: x.astype(np.float64) for name, x in features.items()},
        targets={name: gather([of_episode[name].numpy() for of_episode in targets]) for name in targets[0]},
        tasks=per_frame([episode.task for episode in episodes]),
        variations=per_frame([variation_of(episode) for episode in episodes]),
        to_fit=to_fit if n_fit else None,
    )


def _scores(pca: PCA, pixels: np.ndarray) -> np.ndarray:
    """Principal components (N, K) with a mean variance of 1, in their own proportions."""
    return pca.transform(pixels) / np.sqrt(pca.explained_variance_.mean())


def splits(frames: Frames, rows: np.ndarray) -> list[Split]:
    """Split `rows` into the training data and the rest, or into folds that share no variation.

    Returns:
        Rows to fit to and to test on; none, with a warning, where there are too few variations to fit, choose the
        penalty and test on different ones.
    """
    of_rows = frames.variations[rows]
    to_fit = np.ones(len(rows), bool) if frames.to_fit is None else frames.to_fit[rows]
    n, needed = len(np.unique(of_rows[to_fit])), 3 if frames.to_fit is None else 2
    if n < needed:
        logger.warning(
            "No probes of '%s': they need %d episodes of different variations to fit, and there are %d. Use a dataset "
            "with more, or raise --episodes_per_task.",
            frames.tasks[rows[0]],
            needed,
            n,
        )
        return []
    if frames.to_fit is not None:
        return [(rows[to_fit], rows[~to_fit])]
    folds = GroupKFold(min(FOLDS, n)).split(rows, groups=of_rows)
    return [(rows[fit], rows[test]) for fit, test in folds]


def fit_ridge(x: np.ndarray, y: np.ndarray, variations: np.ndarray, *, standardise: bool) -> Pipeline:
    """Ridge regression (N, D) -> (N, 3) whose penalty does best on variations that were left out.

    Args:
        x: Features.
        y: Targets.
        variations: Folds share none of these, (N,).
        standardise: Give every feature a variance of 1; not where their scales mean something, as in principal
            components.
    """
    folds = GroupKFold(min(FOLDS, len(np.unique(variations))))
    search = GridSearchCV(Ridge(), {"alpha": ALPHAS}, cv=folds, scoring="neg_mean_squared_error")
    model = make_pipeline(StandardScaler(with_std=standardise), search)
    return model.fit(x, y, gridsearchcv__groups=variations)


def probe_positions(frames: Frames) -> list[dict]:
    """Error of each target per task and representation, and its mean over tasks.

    There is one probe per task, since the object differs between tasks; tasks with too few variations are left out. The
    error of positions is their distance in cm; that of other vectors is the root mean square over their numbers, each
    in standard deviations. `r2` is the share of the held-out variance that is explained, summed over a target's
    numbers; below 0 is worse than their mean.
    """
    rows = []
    in_cm = set(frames.targets) == set(POSITIONS)
    median, mean = ("median_cm", "mean_cm") if in_cm else ("median_std", "mean_std")
    targets = frames.targets if in_cm else _standardised(frames.targets)
    for task in tqdm(dict.fromkeys(frames.tasks.tolist()), desc="Probing", unit="task"):
        of_task = np.flatnonzero(frames.tasks == task)
        divided = splits(frames, of_task)
        for target, truth in targets.items() if divided else ():
            factor = _CM if in_cm else truth.shape[1] ** -0.5
            for name in REPRESENTATIONS:
                x = frames.features[name]
                tested, predicted = [], []
                for fit, test in divided:
                    if name == BLIND:
                        probe = DummyRegressor().fit(x[fit], truth[fit])
                    else:
                        variations = frames.variations[fit]
                        probe = fit_ridge(x[fit], truth[fit], variations, standardise=name != PIXELS)
                    tested.append(truth[test])
                    predicted.append(probe.predict(x[test]))
                y, y_hat = np.concatenate(tested), np.concatenate(predicted)
                error = factor * np.linalg.norm(y - y_hat, axis=1)
                rows.append(
                    {
                        "task": task,
                        "target": target,
                        "representation": name,
                        median: float(np.median(error)),
                        mean: float(error.mean()),
                        "r2": float(r2_score(y, y_hat, multioutput="variance_weighted")),
                    }
                )
    if not rows:
        return []
    groups = pd.DataFrame(rows).groupby(["target", "representation"], sort=False, as_index=False)
    means = groups[[median, mean, "r2"]].mean().assign(task=MEAN_OF_TASKS)
    return rows + means.to_dict("records")


def _standardised(targets: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Targets (N, ·) with a variance of 1, without numbers that never change."""
    moving = {name: values[:, values.std(0) > 0] for name, values in targets.items()}
    return {name: values / values.std(0) for name, values in moving.items() if values.shape[1]}


def probe_task(frames: Frames) -> list[dict]:
    """Share of frames whose task a logistic regression finds, by representation; empty where there is one task.

    Also empty where there are too few variations.
    """
    if len(set(frames.tasks if frames.to_fit is None else frames.tasks[frames.to_fit])) == 1:
        return []
    rows = []
    divided = splits(frames, np.arange(len(frames.tasks)))
    for name in REPRESENTATIONS if divided else ():
        x = frames.features[name]
        correct = []
        for fit, test in divided:
            if name == BLIND:
                probe = DummyClassifier()
            else:
                scaler = StandardScaler(with_std=name != PIXELS)
                probe = make_pipeline(scaler, LogisticRegression(max_iter=_LOGISTIC_ITERATIONS))
            probe.fit(x[fit], frames.tasks[fit])
            correct.append(probe.predict(x[test]) == frames.tasks[test])
        rows.append({"representation": name, "accuracy": float(np.concatenate(correct).mean())})
    return rows
