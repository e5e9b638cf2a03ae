"""Training stops at the first loss or gradient that is not finite, before it reaches a checkpoint."""

from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_wm.data.loader import RamLoader


class DivergenceError(RuntimeError):
    """The loss or its gradient is NaN or infinite; its text is one line: which part of the loss, on which episodes."""


class LossWatch:
    """Looks at each step's loss and gradient, and remembers the loss's parts to name the one that is not finite."""

    def __init__(self) -> None:
        self._parts: dict[str, Any] = {}
        self._trained: list[tuple[str, nn.Parameter]] = []
        self._config: object = None

    def attach(self, model: nn.Module) -> None:
        """Follow a LeRobot policy, prepared for training; its `forward` returns the loss and its parts by name."""
        self._config = getattr(model, "config", None)
        self._trained = [
            (name, parameter) for name, parameter in model.named_parameters() if parameter.requires_grad
        ]
        model.forward = self._noting(model.forward)  # LeRobot calls it by name, past the hooks of modules

    def _noting(self, forward: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(forward)
        def noted(*args: Any, **kwargs: Any) -> Any:
            loss, parts = forward(*args, **kwargs)
            self._parts = parts or {}
            return loss, parts

        return noted

    def check(self, loss: Tensor, served: RamLoader, last_checkpoint: Path, n_processes: int = 1) -> None:
        """Look at a step between its backward pass and the optimizer's.

        Processes that train together find a gradient that is not finite at the same step: they have averaged it.

        Args:
            loss: The scalar.
            served: The batch is the last it served.
            last_checkpoint: Where to go on from, if it is there.
            n_processes: How many train together.

        Raises:
            DivergenceError: The loss or a gradient is not finite.
        """
        gradients = [parameter.grad for _, parameter in self._trained if parameter.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        if bool((loss.detach() + norm).isfinite()):
            return
        parts = ", ".join(self._broken_parts()) or f"the gradient of {next(self._broken_gradients(), 'all')}"
        where = f"on a batch of the episodes {', '.join(map(str, served.episodes))}"
        if n_processes > 1 and loss.isfinite():  # its own batch may be innocent
            where = f"in one of {n_processes} processes, of which this one was {where}"
        saved = (
            f"the last checkpoint, {last_checkpoint}, is whole"
            if last_checkpoint.exists()
            else "none is saved yet"
        )
        raise DivergenceError(
            f"training diverged: {parts} is NaN or Inf {where}. It reached no checkpoint; {saved}. "
            f"{self._mend(last_checkpoint.exists())}"
        )

    def _mend(self, can_go_on: bool) -> str:
        rates = [f"--policy.{name}" for name in ("lr", "optimizer_lr") if hasattr(self._config, name)]
        mend = f"Train again with a lower {(rates or ['learning rate'])[0]}"
        if getattr(self._config, "dtype", None) != "bfloat16":
            return f"{mend}."
        return f"{mend}, or {'go on' if can_go_on else 'train'} in --policy.dtype=float32."

    def _broken_parts(self) -> Iterator[str]:
        for name, value in self._parts.items():
            if isinstance(value, float) and not -float("inf") < value < float("inf"):
                yield f"the loss's part '{name}'"

    def _broken_gradients(self) -> Iterator[str]:
        for name, parameter in self._trained:
            if parameter.grad is not None and not parameter.grad.isfinite().all():
                yield name
