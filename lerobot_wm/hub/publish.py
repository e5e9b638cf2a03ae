"""`lerobot-wm publish`: a finished checkpoint to the Hub in one commit, with a card that holds its results.

`--policy.push_to_hub` publishes what training ends with, when there is no evaluation yet. This adds one afterwards.
"""

import io
from dataclasses import dataclass, replace
from pathlib import Path

import draccus
import numpy as np
from huggingface_hub import CommitOperationAdd, HfApi
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class
from PIL import Image

from lerobot_wm.data.options import SourceConfig
from lerobot_wm.data.source import dataset_folder
from lerobot_wm.hub.errors import check_can_push
from lerobot_wm.hub.model_card import IMAGINATION, TrainingData, model_card
from lerobot_wm.inspect.episodes import check_features
from lerobot_wm.inspect.open_loop import CONTEXT, HORIZONS, OpenLoop, load_world_model, open_loop
from lerobot_wm.markdown import escaped
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.records import Record, find_records, read_records
from lerobot_wm.tables import Cell, ReportTable, markdown_table, table_by_split

SCALE = 2  # pixels of the animation per pixel of an image
FRAME_MS = 80
PAUSE_MS = 1000  # on the last frame, before it begins again


def animation(results: list[OpenLoop]) -> bytes:
    """A WebP file that loops, a column per task. A white line between the two appears when the model imagines.

    Args:
        results: one per task.
    """
    columns = [_column(result) for result in results]
    frames = np.concatenate(columns, axis=2).repeat(SCALE, axis=1).repeat(SCALE, axis=2)  # (T, H, W, 3)
    pictures = [Image.fromarray(frame) for frame in frames]
    durations = [FRAME_MS] * (len(pictures) - 1) + [PAUSE_MS]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "WEBP", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=70
    )
    return buffer.getvalue()


def psnr_table(results: list[OpenLoop]) -> ReportTable:
    """Tasks down, steps ahead of the last frame seen across."""
    rows: list[tuple[str, list[Cell]]] = [
        (
            result.task,
            [f"{ours:.1f} ({copy:.1f})" for ours, copy in zip(result.psnr, result.copy_psnr, strict=True)],
        )
        for result in results
    ]
    episodes = max(result.n_episodes for result in results)
    note = (
        f"PSNR in dB of images imagined from {CONTEXT} frames and the actions that followed, over the last episodes of "
        f"each task (up to {episodes}); in brackets: of repeating the last frame seen."
    )
    return ReportTable("Open-loop prediction", "task", [f"+{step}" for step in HORIZONS], rows, notes=[note])


def _column(result: OpenLoop) -> np.ndarray:
    """Frames of one task, (T, 2H + 1, W, 3) uint8: truth, a line, what the model saw and then imagines."""
    below = np.concatenate([result.truth[:CONTEXT], result.imagined])  # (T, C, H, W)
    line = np.zeros_like(below[:, :, :1])
    line[CONTEXT:] = 1
    stacked = np.concatenate([result.truth, line, below], axis=2)
    return (255 * stacked.clip(0, 1)).round().astype(np.uint8).transpose(0, 2, 3, 1)


UPLOADED = ("*.safetensors", "*.json", "*.yaml")  # of a checkpoint's folder, as LeRobot uploads them


@dataclass
class CheckpointFolder:
    """`--policy.path`, a folder.

    Args:
        path: `.../checkpoints/last/pretrained_model`.
    """

    path: Path


@dataclass
class PublishConfig:
    """Flags of `lerobot-wm publish`.

    Args:
        policy: The checkpoint.
        repo_id: Where to, as user/name; what is there already and has not changed is not sent again.
        records: Records of `lerobot-wm eval` of this checkpoint, for the card's table; None for none.
        dataset: An image dataset of which the card shows an episode of each task, and what the world model imagines of
            it; None for no animation.
        private: Make the repository private where it is new.
    """

    policy: CheckpointFolder
    repo_id: str
    records: str | None = None
    dataset: SourceConfig | None = None
    private: bool = False


def publish(cfg: PublishConfig) -> str:
    """Upload a checkpoint and its card.

    Returns:
        Address of the commit.

    Raises:
        FileNotFoundError: The folder is no checkpoint, or there are no records.
        ValueError: The records are not of this policy, there is no world model that could imagine, or the dataset lacks
            what it reads.
    """
    folder = cfg.policy.path
    if not (folder / TRAIN_CONFIG_NAME).is_file():
        raise FileNotFoundError(
            f"{folder} is no checkpoint of a training run: it holds no {TRAIN_CONFIG_NAME}. "
            "Give --policy.path=<output_dir>/checkpoints/last/pretrained_model."
        )
    config = PreTrainedConfig.from_pretrained(folder)
    run = TrainPipelineConfig.from_pretrained(folder)
    tables: list[ReportTable] = []
    if cfg.records is not None:
        records = read_records(find_records(cfg.records))
        check_records(records, config.type, run.seed)
        title = f"Results ({records[0]['arm']}, preset {records[0]['preset']})"
        tables.append(table_by_split(title, records))
    files: dict[str, Path | bytes] = {
        path.name: path for pattern in UPLOADED for path in sorted(folder.glob(pattern))
    }
    tasks = None
    if cfg.dataset is not None:
        policy = load_world_model(str(folder))
        meta = cfg.dataset.metadata()
        check_features(policy, meta)
        predictions = open_loop(policy, meta, cfg.dataset)
        if predictions:
            files[IMAGINATION] = animation(predictions)
            tasks = [prediction.task for prediction in predictions]
            tables.append(psnr_table(predictions))
    results = "".join(map(_section, tables)) or None
    card = model_card(
        get_policy_class(config.type),
        config,
        cfg.repo_id,
        run,
        _training_data(run),
        results,
        tasks,
        features_read=config.features_read,
        makes_latents=isinstance(config, WorldModelConfig),
    )
    files["README.md"] = str(card).encode()
    return _upload(files, cfg.repo_id, cfg.private)


def check_records(records: list[Record], policy_type: str, seed: int | None) -> None:
    """Refuse records of another policy than the one published.

    Raises:
        ValueError: They are of several arms, of another type, or of another training seed.
    """
    arms = sorted({record["arm"] for record in records})
    if len(arms) > 1:
        raise ValueError(
            f"The records are of the arms {', '.join(arms)}; expected those of this checkpoint alone."
        )
    found = {(record["policy_type"], record["seed"]) for record in records}
    if found != {(policy_type, seed)}:
        others = ", ".join(f"{kind} with training seed {s}" for kind, s in sorted(found, key=str))
        raise ValueError(
            f"The records are of {others}; this checkpoint is {policy_type} with training seed {seed}. "
            "Give the records of its own evaluation."
        )


def _section(table: ReportTable) -> str:
    """A table in Markdown; names in it are escaped."""
    rows = [(escaped(label), cells) for label, cells in table.rows]
    return markdown_table(replace(table, title=escaped(table.title), rows=rows))


def _training_data(run: TrainPipelineConfig) -> TrainingData | None:
    """What the run was trained on, where that is still on this machine."""
    root = dataset_folder(run.dataset.repo_id, run.dataset.root, run.dataset.revision, whole=True)
    if root is None:
        return None
    return TrainingData.of(LeRobotDatasetMetadata(run.dataset.repo_id, root=root))


def _upload(files: dict[str, Path | bytes], repo_id: str, private: bool) -> str:
    """All files in one commit, so that nobody sees half of them."""
    api = HfApi()
    api.create_repo(repo_id, private=private, exist_ok=True)
    operations = [
        CommitOperationAdd(path_in_repo=name, path_or_fileobj=content) for name, content in files.items()
    ]
    return api.create_commit(repo_id, operations, commit_message="Publish checkpoint and card").commit_url


def main() -> None:
    """Entry point of `lerobot-wm publish`."""
    cfg = draccus.parse(PublishConfig)
    check_can_push(cfg.repo_id)
    print(f"Published: {publish(cfg)}")
