"""Dropout whose masks are cheap on a CPU."""

import torch
from torch import Tensor, nn

_LEVELS = 2**16  # of a random 16-bit integer


class Dropout(nn.Module):
    """`nn.Dropout`, whose mask on a CPU takes four units from each random number, not one.

    PyTorch draws a number for each unit there: of an update of a small policy that is a third.

    Args:
        p: Probability of zeroing a unit; on a CPU to the nearest of 1/65536, unless that is 0 or 1.

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
        """Units (...) with some zeroed and the others scaled up while training, else as they are."""
        if not self.training or x.device.type != "cpu" or not 0 < self._dropped < _LEVELS:
            return nn.functional.dropout(x, self.p, self.training)
        n = x.numel()
        drawn = torch.randint(-(2**63), 2**63 - 1, ((n + 3) // 4,))  # int64
        lowest_kept = self._dropped - _LEVELS // 2
        # 1 where a unit is kept and 0 elsewhere, without a comparison: turning numbers into bool and back takes three
        # times as long as all of this.
        kept = drawn.view(torch.int16)[:n].view(x.shape).clamp_(lowest_kept - 1, lowest_kept)  # (...)
        scale = kept.sub_(lowest_kept - 1).to(x.dtype).mul_(_LEVELS / (_LEVELS - self._dropped))
        return x * scale

    def extra_repr(self) -> str:
        """As of `nn.Dropout`."""
        return f"p={self.p}"
