"""Layers that compute the same as PyTorch's own, but faster on a CPU."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

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


class _ParityConvTranspose(torch.autograd.Function):
    """A stride-2 transposed convolution, computed as a 3x3 convolution and a pixel shuffle.

    Output pixels with the same parity in x and y see the same taps of the kernel, so the four parities become four
    channels of one ordinary convolution. oneDNN runs it three times faster than the transposed form when there are
    few output channels or few pixels. The backward pass is already fast and stays PyTorch's.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        c_in, c_out, kernel, _ = weight.shape
        padded = F.pad(weight, (0, 6 - kernel, 0, 6 - kernel))  # (C_in, C_out, 6, 6)
        # Tap 2j + r of the kernel adds input q - j to output 2q + r.
        taps = padded.reshape(c_in, c_out, 3, 2, 3, 2).flip(2, 4).permute(1, 3, 5, 0, 2, 4)
        parities = F.conv2d(x, taps.reshape(4 * c_out, c_in, 3, 3), bias.repeat_interleave(4), padding=2)
        out = F.pixel_shuffle(parities, 2)  # (N, C_out, 2H + 4, 2W + 4)
        # Copy the crop: the next activation works in place, which autograd forbids on views.
        return out if kernel == 6 else out[..., :-1, :-1].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        grad = grads[0].contiguous(memory_format=torch.channels_last)
        stride, padding, dilation, output_padding = [2, 2], [0, 0], [1, 1], [0, 0]
        return torch.ops.aten.convolution_backward(
            grad, x, weight, [weight.shape[1]], stride, padding, dilation, True, output_padding, 1, [True] * 3
        )


class UpsamplingConv(nn.ConvTranspose2d):
    """A stride-2 transposed convolution without padding, kernel 5 or 6, faster on CPUs."""

    def __init__(self, c_in: int, c_out: int, kernel_size: int) -> None:
        super().__init__(c_in, c_out, kernel_size, stride=2)

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # output_size is never asked for
        """Map (N, C_in, H, W) to (N, C_out, 2H + k - 2, 2W + k - 2)."""
        if x.device.type != "cpu":
            return super().forward(x)
        bias = self.get_parameter("bias")
        return _ParityConvTranspose.apply(x, self.weight.to(x.dtype), bias.to(x.dtype))
