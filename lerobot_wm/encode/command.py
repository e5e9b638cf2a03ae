"""`lerobot-wm encode`: encode an image dataset with a frozen world model."""

from dataclasses import dataclass, field
from pathlib import Path

import draccus
from huggingface_hub import DatasetCard
from huggingface_hub.constants import ENDPOINT
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.device_utils import auto_select_torch_device

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.data.latents import LatentKind, LatentRecord, dataset_fingerprint
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.dataset import encode, encode_job, latent_record
from lerobot_wm.errors import check_can_push
from lerobot_wm.files import sole_writer
from lerobot_wm.markdown import render
from lerobot_wm.policies.frozen_backbone.modeling_frozen_backbone import FrozenBackbone
from lerobot_wm.policies.latent.policy import load_encoder
from lerobot_wm.workers import Job, check_same_settings


@dataclass
class EncodeConfig:
    """Flags of `lerobot-wm encode`.

    Args:
        world_model_path: Folder or Hub id (user/name or user/name@revision) of a wm_rssm or frozen_backbone checkpoint,
            or of a policy on latents, which contains its world model.
        dataset: The image dataset.
        output_repo_id: Repository id of the latent dataset.
        output_root: Folder of the latent dataset; must not exist yet.
        rename_map: The world model's names for cameras and proprioception of the dataset, where they differ, as in
            `lerobot-train`. Features in the latent dataset keep the dataset's own names.
        use_memory: False encodes each frame by itself, for a policy with `--policy.use_memory=false`.
        random_crop_pad: Also encode each image shifted at random by up to so many pixels, eight times, for a policy
            with `--policy.random_crop_pad`; 0 for none.
        device: Device of the world model; None selects the fastest one.
        shard: Which of several jobs this is: 1/4 is the first of four. Each job encodes its part of the episodes into
            `<output_root>.parts`; when all are in one folder, the same command without this flag makes the dataset.
            Machines that share a disk need different folders in LEROBOT_WM_CACHE, because they must not decode frames
            into one file.
        push_to_hub: Upload the result as `output_repo_id`, even if an earlier run encoded it.
        private: Upload to a private repository.
        license: Licence of the uploaded dataset, as the Hub names it; None takes it from the source's card.
    """

    world_model_path: str
    dataset: SourceConfig
    output_repo_id: str
    output_root: Path
    rename_map: dict[str, str] = field(default_factory=dict)
    use_memory: bool = True
    random_crop_pad: int = 0
    device: str | None = None
    shard: str | None = None
    push_to_hub: bool = False
    private: bool = False
    license: str | None = None


def main() -> None:
    """Entry point of `lerobot-wm encode`."""
    cfg = draccus.parse(EncodeConfig)
    if cfg.push_to_hub:
        check_can_push(cfg.output_repo_id)
    job = Job.parse(cfg.shard) if cfg.shard else None
    with sole_writer(cfg.output_root, job.lock_name if job else None):
        _run(cfg, job)


def _run(cfg: EncodeConfig, job: Job | None) -> None:
    policy = load_encoder(cfg.world_model_path)
    policy.to(cfg.device or auto_select_torch_device())
    source, kind = cfg.dataset.open(), LatentKind(cfg.use_memory, cfg.random_crop_pad)
    if job is not None:
        encode_job(policy, source, cfg.output_root, job, rename_map=cfg.rename_map, kind=kind)
        return
    if cfg.push_to_hub and cfg.output_root.exists():
        # An earlier push did not finish.
        check_same_settings(
            LatentRecord.read(cfg.output_root).made_of,
            latent_record(policy, source, cfg.rename_map, kind).made_of,
            f"{cfg.output_root} has latents",
            "choose another --output_root, or remove it",
        )
        dataset = LeRobotDataset(cfg.output_repo_id, root=cfg.output_root)
    else:
        dataset = encode(
            policy,
            source,
            cfg.output_repo_id,
            cfg.output_root,
            rename_map=cfg.rename_map,
            kind=kind,
        )
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames -> {cfg.output_root}")
    if cfg.push_to_hub:
        encoder = "image backbone" if isinstance(policy.world_model, FrozenBackbone) else "world model"
        push_latents(dataset, encoder, cfg.world_model_path, cfg.private, cfg.license or _license_of(source))


def push_latents(
    dataset: LeRobotDataset, encoder: str, encoder_path: str, private: bool, license: str | None
) -> None:
    """Push a latent dataset and its card.

    Args:
        dataset: The latent dataset.
        encoder: What encoded it: "world model" or "image backbone".
        encoder_path: Folder or Hub id of the encoder.
        private: Whether a new repository is private.
        license: The dataset's licence, as the Hub names it; None for none.
    """
    record = LatentRecord.read(Path(dataset.root))
    description = render(
        Path(__file__).with_name("latents.md.j2"),
        repo_id=dataset.repo_id,
        record=record,
        encoder=encoder,
        encoder_id=None if Path(encoder_path).exists() else encoder_path,
        n_episodes=dataset.num_episodes,
        n_frames=dataset.num_frames,
        n_dims=dataset.features[OBS_LATENT]["shape"][0],
        fingerprint=dataset_fingerprint(Path(dataset.root)),
    )
    # LeRobot sets the version tag last, and reads nothing without it: readers see the dataset once it is complete.
    dataset.push_to_hub(
        tags=["lerobot_wm", "latents"],
        license=license,
        private=private,
        dataset_description=description,
        url=f"{ENDPOINT}/datasets/{record.source_repo_id}",
        paper="World Models for Multi-task Robotic Pretraining",
    )
    print(f"Dataset pushed to {ENDPOINT}/datasets/{dataset.repo_id}")


def _license_of(dataset: LeRobotDataset) -> str | None:
    """The licence on the dataset's own card, if it has one."""
    card = Path(dataset.root) / "README.md"
    return DatasetCard.load(card).data.license if card.is_file() else None
