"""Cards of the datasets our commands make, and pushing them with LeRobot's own `push_to_hub`."""

from pathlib import Path
from typing import Any

from huggingface_hub import DatasetCard
from huggingface_hub.constants import ENDPOINT
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.markdown import Markdown, render

PAPER = "World Models for Multi-task Robotic Pretraining"
META_WORLD_PAPER = "Meta-World, https://arxiv.org/abs/1910.10897"
META_WORLD_BIBTEX = """@inproceedings{yu2019meta,
  title={Meta-World: A Benchmark and Evaluation for Multi-Task and Meta Reinforcement Learning},
  author={Yu, Tianhe and Quillen, Deirdre and He, Zhanpeng and Julian, Ryan and Hausman, Karol and Finn, Chelsea
          and Levine, Sergey},
  booktitle={Conference on Robot Learning},
  year={2019}
}"""


def push_demonstrations(dataset: LeRobotDataset, record: dict[str, Any], private: bool, license: str) -> None:
    """Push a dataset of `lerobot-wm collect`; a reader sees it when all of it is there.

    Args:
        dataset: The dataset.
        record: Its `meta/collection.json`.
        private: Whether to make the repository private where it is new.
        license: Its licence, as the Hub names it.
    """
    episodes = record["episodes"]
    tasks = [
        _task_row(task, [e for e in episodes if e["task"] == task], record)
        for task in record["config"]["tasks"]
    ]
    description = render(
        Path(__file__).with_name("demonstrations.md.j2"),
        repo_id=dataset.repo_id,
        config=record["config"],
        versions=record["versions"],
        tasks=tasks,
        n_episodes=dataset.num_episodes,
        n_frames=dataset.num_frames,
        fps=dataset.fps,
        fingerprint=dataset_fingerprint(Path(dataset.root)),
        command=Markdown(_collect_command(record["config"], dataset.repo_id)),
    )
    _push(
        dataset,
        private,
        license,
        tags=["metaworld", "demonstrations"],
        dataset_description=description,
        url="https://meta-world.github.io",
        paper=META_WORLD_PAPER,
        citation_bibtex=META_WORLD_BIBTEX,
    )


def push_latents(
    dataset: LeRobotDataset,
    record: LatentRecord,
    encoder: str,
    encoder_path: str,
    private: bool,
    license: str | None,
) -> None:
    """Push a dataset of `lerobot-wm encode`; a reader sees it when all of it is there.

    Args:
        dataset: The dataset.
        record: Its `meta/latents.json`.
        encoder: What encoded it: "world model" or "image backbone".
        encoder_path: Folder or Hub id of that.
        private: Whether to make the repository private where it is new.
        license: Its licence, as the Hub names it; None leaves it open.
    """
    description = render(
        Path(__file__).with_name("latents.md.j2"),
        repo_id=dataset.repo_id,
        record=record,
        encoder=encoder,
        encoder_id=None if Path(encoder_path).exists() else encoder_path,
        n_episodes=dataset.num_episodes,
        n_frames=dataset.num_frames,
        n_dims=dataset.features["observation.latent"]["shape"][0],
        fingerprint=dataset_fingerprint(Path(dataset.root)),
    )
    _push(
        dataset,
        private,
        license,
        tags=["latents"],
        dataset_description=description,
        url=f"{ENDPOINT}/datasets/{record.source_repo_id}",
        paper=PAPER,
    )


def license_of(dataset: LeRobotDataset) -> str | None:
    """What the dataset's own card, where it came with one, says of its licence."""
    card = Path(dataset.root) / "README.md"
    return DatasetCard.load(card).data.license if card.is_file() else None


def _push(dataset: LeRobotDataset, private: bool, license: str | None, tags: list[str], **card: str) -> None:
    # LeRobot tags the version after all else, and reads nothing that has no such tag.
    dataset.push_to_hub(tags=["lerobot_wm", *tags], license=license, private=private, **card)
    print(f"Dataset pushed to {ENDPOINT}/datasets/{dataset.repo_id}")


def _task_row(task: str, episodes: list[dict[str, Any]], record: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": task,
        "string": task_description(task),
        "episodes": len(episodes),
        "steps": sum(e["length"] for e in episodes) / len(episodes),
        "variations": _ranges(sorted({e["variation"] for e in episodes})),
        "failed": sum(record["failed_attempts"].get(task, {}).values()),
        "moved": sum(e["moved"] for e in episodes),
        "expert": record["experts"][task],
    }


def _ranges(numbers: list[int]) -> str:
    """0, 1, 2, 5 as "0-2, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _collect_command(config: dict[str, Any], repo_id: str) -> str:
    """The command that makes these demonstrations again."""
    values = {**config, "tasks": ",".join(config["tasks"])}
    values["variations"] = _ranges(config["variations"]).replace(" ", "")
    return " ".join(
        ["lerobot-wm collect", *(f"--{key}={value}" for key, value in values.items()), f"--repo_id={repo_id}"]
    )
