"""Multi-layer perceptrons."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

_LEVELS = 2**16  # values of a random 16-bit integer


class Dropout(nn.Module):
    """`nn.Dropout` that, on a CPU, draws one random number for four units.

    PyTorch draws one number per unit, which takes a third of the time of a small policy's update.

    Args:
        p: Probability of zeroing a unit. On a CPU it is rounded to a multiple of 1/65536.

    Raises:
        ValueError: p is not in [0, 1).
    """

    def __init__(self, p: float) -> None:
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"dropout {p}: expected a probability of at least 0 and less than 1")
        self.p = p
        self._dropped = round(p * _LEVELS)

    def forward(self, x: Tensor) -> Tensor:
        """Zero some units of x (...) and scale up the others in training; return x unchanged in evaluation."""
        if not self.training or x.device.type != "cpu" or not 0 < self._dropped < _LEVELS:
            return nn.functional.dropout(x, self.p, self.training)
        n = x.numel()
        drawn = torch.randint(-(2**63), 2**63 - 1, ((n + 3) // 4,))  # int64
        lowest_kept = self._dropped - _LEVELS // 2
        # 1 where a unit is kept, 0 elsewhere. Clamping avoids a comparison: casting to bool and back takes three times
        # as long as the rest of this function.
        kept = drawn.view(torch.int16)[:n].view(x.shape).clamp_(lowest_kept - 1, lowest_kept)  # (...)
        scale = kept.sub_(lowest_kept - 1).to(x.dtype).mul_(_LEVELS / (_LEVELS - self._dropped))
        return x * scale

    def extra_repr(self) -> str:
        """Show the probability, as `nn.Dropout` does."""
        return f"p={self.p}"


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
