"""--policy.compile_model=true: the same training, its networks compiled."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import torch._inductor.config as inductor_config
from safetensors.torch import load_file

from tests.flags import DATASET_FLAGS, SMALL_WORLD_MODEL, TRAIN_FLAGS

EXACT = "--policy.dtype=float32 --batch_size=4 --steps=2 --save_freq=2"


def weights_after_training(
    command: Callable[..., None], folder: Path, *flags: str
) -> dict[str, dict[str, torch.Tensor]]:
    """The weights after two steps, plain and compiled."""
    weights = {}
    for compiled in ("false", "true"):
        run = folder / compiled
        command("train", f"--policy.compile_model={compiled} --output_dir={run}", EXACT, TRAIN_FLAGS, *flags)
        weights[compiled] = load_file(run / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    return weights


@pytest.fixture(params=["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def compilations(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The functions that are compiled, each with the noise of the plain one.

    What takes a minute is to generate code; `aot_eager` captures the same operations and leaves that out.
    """
    found = []
    compile_function, backend = torch.compile, request.param

    def noting(function: Callable, *, mode: str, dynamic: bool) -> Callable:
        found.append(function.__name__)
        how = {"mode": mode} if backend == "inductor" else {"backend": backend}
        return compile_function(function, dynamic=dynamic, fullgraph=True, **how)

    monkeypatch.setattr(torch, "compile", noting)
    torch.compiler.reset()
    with inductor_config.patch(fallback_random=True):
        yield found
    torch.compiler.reset()


def check_equal(weights: dict[str, dict[str, torch.Tensor]]) -> None:
    for name, plain in weights["false"].items():
        torch.testing.assert_close(weights["true"][name], plain, rtol=1e-3, atol=1e-5, msg=name)


@pytest.mark.parametrize("policy_type", ["wm_bc", "wm_iql"])
def test_a_compiled_policy_learns_as_a_plain_one(
    policy_type: str,
    latents_root: Path,
    world_model_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    compilations: list[str],
) -> None:
    weights = weights_after_training(
        lerobot_wm_command,
        tmp_path,
        f"--policy.type={policy_type} --policy.world_model_path={world_model_path} --policy.hidden_dims=[16,16]",
        f"--dataset.repo_id=test/latents --dataset.root={latents_root}",
    )
    assert compilations == ["loss"]
    check_equal(weights)


def test_a_compiled_world_model_learns_as_a_plain_one(
    demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None], compilations: list[str]
) -> None:
    weights = weights_after_training(
        lerobot_wm_command,
        tmp_path,
        "--policy.type=wm_rssm --policy.window_length=3",
        SMALL_WORLD_MODEL,
        DATASET_FLAGS.format(root=demos_root),
    )
    assert compilations == ["observe"]
    check_equal(weights)
