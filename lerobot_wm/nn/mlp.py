"""Multi-layer perceptrons."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_wm.nn.fast_cpu import Dropout


class MLP(nn.Module):
    """Hidden layers with an activation (and dropout) after each, then a linear output layer.

    The output layer runs in float32 even under autocast: its outputs (actions, values, rewards) are compared with
    targets that differ by less than bfloat16 can resolve.

    Args:
        input_dim: Size of the last axis of the input.
        hidden_dims: Width of each hidden layer.
        output_dim: Size of the last axis of the output.
        activation: Module class applied after every hidden layer.
        dropout: Probability of zeroing a hidden unit during training; 0 adds no dropout layer.
    """

    def __init__(
        self,
        input_dim: int,
        hidden_dims: Sequence[int],
        output_dim: int,
        activation: type[nn.Module] = nn.ELU,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for hidden_dim in hidden_dims:
            layers += [nn.Linear(input_dim, hidden_dim), activation()]
            if dropout > 0:
                layers.append(Dropout(dropout))
            input_dim = hidden_dim
        self.trunk = nn.Sequential(*layers)
        self.head = nn.Linear(input_dim, output_dim)

    @torch.no_grad()
    def insert_inputs(self, place: int, count: int) -> None:
        """Add `count` inputs at index `place`. Their weights are zero, so the output does not change yet.

        The first layer's weight becomes a new parameter: create the optimizer afterwards.
        """
        first = next(layer for layer in self.modules() if isinstance(layer, nn.Linear))
        before, after = first.weight[:, :place], first.weight[:, place:]
        zeros = first.weight.new_zeros(first.out_features, count)
        first.weight = nn.Parameter(torch.cat([before, zeros, after], dim=1), first.weight.requires_grad)
        first.in_features += count

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., input_dim) to float32 (..., output_dim)."""
        hidden = self.trunk(x)  # (..., hidden_dims[-1])
        with torch.autocast(x.device.type, enabled=False):
            return self.head(hidden.float())


def orthogonal_init(module: nn.Module) -> None:
    """Orthogonal weights with gain √2 and zero biases for every linear layer (IQL reference, Kostrikov 2021)."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain=2**0.5)
            nn.init.zeros_(layer.bias)
