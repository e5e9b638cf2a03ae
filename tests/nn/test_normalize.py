"""Scalings of vectors."""

import torch

from lerobot_wm.nn.normalize import Affine


def test_what_is_constant_in_the_data_stays_so() -> None:
    """A joint that rested at 0.5 in every demonstration is commanded 0.5, whatever noise a policy adds."""
    scaling = Affine(2)
    scaling.set_range(torch.tensor([0.5, -1.0]), torch.tensor([0.5, 3.0]))
    action = torch.tensor([[0.5, 3.0], [0.7, 1.0]])
    scaled = scaling(action)
    torch.testing.assert_close(scaled, torch.tensor([[0.0, 1.0], [0.2, 0.0]]))
    torch.testing.assert_close(scaling.inverse(scaled), torch.tensor([[0.5, 3.0], [0.5, 1.0]]))
