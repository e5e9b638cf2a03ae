"""Pushing a collected dataset to the Hub, with a card that says how it was made."""

from pathlib import Path
from typing import Any

from huggingface_hub.constants import ENDPOINT
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.markdown import Markdown, render

META_WORLD_BIBTEX = """@inproceedings{yu2019meta,
  title={Meta-World: A Benchmark and Evaluation for Multi-Task and Meta Reinforcement Learning},
  author={Yu, Tianhe and Quillen, Deirdre and He, Zhanpeng and Julian, Ryan and Hausman, Karol and Finn, Chelsea
          and Levine, Sergey},
  booktitle={Conference on Robot Learning},
  year={2019}
}"""


def push_demonstrations(dataset: LeRobotDataset, record: dict[str, Any], private: bool, license: str) -> None:
    """Push a dataset of `lerobot-wm collect` and its card.

    Args:
        dataset: The dataset.
        record: The content of its `meta/collection.json`.
        private: Whether a new repository is private.
        license: The dataset's licence, as the Hub names it.
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
        n_disturbed=sum(episode.get("disturbed", False) for episode in episodes),
        n_frames=dataset.num_frames,
        fps=dataset.fps,
        fingerprint=dataset_fingerprint(Path(dataset.root)),
        command=Markdown(_collect_command(record["config"], dataset.repo_id)),
    )
    # LeRobot sets the version tag last, and reads nothing without it: readers see the dataset once it is complete.
    dataset.push_to_hub(
        tags=["lerobot_wm", "metaworld", "demonstrations"],
        license=license,
        private=private,
        dataset_description=description,
        url="https://meta-world.github.io",
        paper="Meta-World, https://arxiv.org/abs/1910.10897",
        citation_bibtex=META_WORLD_BIBTEX,
    )
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
    """Write 0, 1, 2, 5 as "0-2, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _collect_command(config: dict[str, Any], repo_id: str) -> str:
    """The command that collects the same demonstrations again."""
    values = {**config, "tasks": ",".join(config["tasks"])}
    values["variations"] = _ranges(config["variations"]).replace(" ", "")
    return " ".join(
        ["lerobot-wm collect", *(f"--{key}={value}" for key, value in values.items()), f"--repo_id={repo_id}"]
    )
