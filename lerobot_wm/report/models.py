"""What the page shows of models: dreams of some episodes, and what `lerobot-wm quality` and `replay` measured."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from tqdm import tqdm

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.dream import Dreams, actions_are_targets, dream, strip_figure, write_dream
from lerobot_wm.inspect.episodes import ImaginingPolicy, episodes_by_task, load_episodes
from lerobot_wm.inspect.open_loop import CONTEXT
from lerobot_wm.inspect.pictures import MP4, PNG, SVG, data_uri, figure_uri
from lerobot_wm.inspect.quality_figures import (
    EXAMPLE_HORIZON,
    EXAMPLES_NAME,
    probe_error,
    quality_figures,
)
from lerobot_wm.inspect.replay import replay_table
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.tables import Cell, Measurement, ReportTable

# One for each of the first tasks.
MAX_DREAMS = 3
# Of an episode; Meta-World's experts need fewer.
MAX_FRAMES = 120


@dataclass(frozen=True)
class DreamClip:
    """The dreams of one episode, their video and their strip, which are data URIs."""

    episode: Episode
    dreams: Dreams
    video: str
    strip: str


def dream_clips(
    policy: ImaginingPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig
) -> list[DreamClip]:
    """Dream of the last episode of each of the first tasks; tasks that a policy does not know are left out.

    Args:
        policy: The world model, or a policy on it, whose own actions are dreamt of too.
        meta: A dataset that it can read, see `check_features`.
        source: Where the dataset is.
    """
    by_task = episodes_by_task(meta, min_length=CONTEXT + 1)
    if isinstance(policy, LatentPolicy):
        by_task = {task: episodes for task, episodes in by_task.items() if task in policy.config.known_tasks}
    chosen = sorted(episodes[-1] for episodes in list(by_task.values())[:MAX_DREAMS])
    if not chosen:
        return []
    episodes = load_episodes(policy, source, chosen, MAX_FRAMES)
    hold = actions_are_targets(meta)
    return [
        _clip(dream(policy, episode, CONTEXT, hold_action=hold), episode, meta.fps)
        for episode in tqdm(episodes, desc="Dreaming", unit="episode")
    ]


def _clip(dreams: Dreams, episode: Episode, fps: int) -> DreamClip:
    with TemporaryDirectory() as folder:
        path = Path(folder, "dream.mp4")
        write_dream(path, dreams, fps)
        video = path.read_bytes()
    return DreamClip(
        episode=episode,
        dreams=dreams,
        video=data_uri(video, MP4),
        strip=figure_uri(strip_figure(dreams), PNG),
    )


# Episodes whose predicted and recorded actions are drawn.
MAX_REPLAYS = 4


def read_replay(path: Path) -> dict[str, Any]:
    """What the page's section on replay shows: its table, and the figures of the first episodes as data URIs.

    Raises:
        FileNotFoundError: One of them is missing.
    """
    content = json.loads(_read(path, "--replay", "replay"))
    episodes = list(dict.fromkeys(row["episode"] for row in content["episodes"]))
    pictures = {
        episode: data_uri(_read(path.with_name(f"episode_{episode}.png"), "--replay", "replay"), PNG)
        for episode in episodes[:MAX_REPLAYS]
    }
    return {"table": replay_table(content), "pictures": pictures, "n_episodes": len(episodes)}


def _read(path: Path, flag: str, command: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{path} is missing: {flag} takes the {command}.json that `lerobot-wm {command}` wrote, in its folder."
        ) from error


def read_quality(path: Path) -> dict[str, Any]:
    """What the page's section on quality shows: the content of quality.json, its figures and tables.

    Args:
        path: A quality.json of `lerobot-wm quality`, with the examples' picture beside it.

    Raises:
        FileNotFoundError: One of the two is missing.
    """
    result = json.loads(_read(path, "--quality", "quality"))
    open_loop, probes = pd.DataFrame(result["open_loop"]), pd.DataFrame(result["probes"])
    return result | {
        "figures": {name: figure_uri(figure, SVG) for name, figure in quality_figures(result).items()},
        "examples": data_uri(_read(path.with_name(EXAMPLES_NAME), "--quality", "quality"), PNG),
        "example_horizon": EXAMPLE_HORIZON,
        "kl_overall": result["kl"]["tasks"][-1],
        "open_loop_table": _open_loop_table(open_loop),
        "foreground_table": _foreground_table(open_loop),
        "reward_table": _reward_table(result["reward"]) if result["reward"] else None,
        "probe_tables": [] if probes.empty else _probe_tables(probes),
        "probe_unit": probe_error(probes)[1],
        "kl_table": _kl_table(result["kl"]["tasks"]),
    }


def _table(
    title: str,
    corner: str,
    rows: pd.DataFrame,
    columns: list[str],
    cell: Callable[[dict], Cell],
    n_totals: int = 1,
) -> ReportTable:
    """A table with a row for each value of the column `corner`, and a cell for each line of it."""
    groups = rows.groupby(corner, sort=False)
    cells = [(str(label), [cell(line) for line in group.to_dict("records")]) for label, group in groups]
    return ReportTable(title, corner, columns, cells, n_totals=n_totals)


def _open_loop_table(table: pd.DataFrame) -> ReportTable:
    """Predictions down, horizons across, over all tasks."""
    overall = table[table["task"] == table["task"].iloc[-1]]
    return _table(
        "Open loop",
        "prediction",
        overall,
        [f"+{horizon}" for horizon in overall["horizon"].unique()],
        lambda row: Measurement(
            _number(row["foreground_psnr"], 1) or "–", f"{row['psnr']:.1f} · {row['ssim']:.2f}"
        ),
        n_totals=0,
    )


def _foreground_table(table: pd.DataFrame) -> ReportTable:
    """Tasks down, predictions across: foreground PSNR at EXAMPLE_HORIZON."""
    chosen = table[table["horizon"] == EXAMPLE_HORIZON]
    title = f"Foreground PSNR {EXAMPLE_HORIZON} steps ahead"
    columns = list(chosen["prediction"].unique())
    return _table(title, "task", chosen, columns, lambda row: _number(row["foreground_psnr"], 1))


def _reward_table(tasks: list[dict[str, Any]]) -> ReportTable:
    rows = [
        (
            row["task"],
            [
                f"{100 * row['base_rate']:.1f}%",
                _number(row["average_precision"], 2),
                _number(row["auroc"], 3),
            ],
        )
        for row in tasks
    ]
    return ReportTable("Reward", "task", ["base rate", "average precision", "AUROC"], rows, n_totals=1)


def _probe_tables(table: pd.DataFrame) -> list[ReportTable]:
    """One table per target: tasks down, representations across."""
    error, _ = probe_error(table)
    digits = 1 if error == "cm" else 2

    def cell(row: dict[str, Any]) -> Measurement:
        median, mean = row[f"median_{error}"], row[f"mean_{error}"]
        return Measurement(f"{median:.{digits}f}", f"{mean:.{digits}f} · {row['r2']:.2f}")

    return [
        _table(
            f"Position of the {target}" if error == "cm" else str(target),
            "task",
            group,
            list(group["representation"].unique()),
            cell,
        )
        for target, group in table.groupby("target", sort=False)
    ]


def _kl_table(tasks: list[dict[str, Any]]) -> ReportTable:
    rows = [
        (
            task["task"],
            [
                f"{100 * task['share_under_free_nats']:.0f}%",
                *(f"{value:.1f}" for value in (task["mean"], *task["percentiles"].values())),
            ],
        )
        for task in tasks
    ]
    columns = ["below free nats", "mean", *(f"percentile {name}" for name in tasks[0]["percentiles"])]
    return ReportTable("KL", "task", columns, rows, n_totals=1)


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None or pd.isna(value) else f"{value:.{digits}f}"
