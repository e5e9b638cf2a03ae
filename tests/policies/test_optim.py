"""Learning-rate schedules."""

import pytest
import torch

from lerobot_wm.policies.common.config import PolicyConfig
from lerobot_wm.policies.common.optim import FinalDecayConfig
from lerobot_wm.policies.e2e_bc.configuration_e2e_bc import E2EBCConfig
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig


def test_the_rate_is_constant_and_falls_to_zero_over_the_last_share_of_the_steps() -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    schedule = FinalDecayConfig(share=0.5).build(optimizer, num_training_steps=8)
    rates = []
    for _ in range(8):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates == [2.0, 2.0, 2.0, 2.0, 2.0, 1.5, 1.0, 0.5]
    assert optimizer.param_groups[0]["lr"] == 0.0


@pytest.mark.parametrize("config_class", [WMRSSMConfig, WMBCConfig, E2EBCConfig])
def test_a_configuration_has_the_schedule_where_it_is_asked_for(config_class: type[PolicyConfig]) -> None:
    assert config_class(device="cpu").get_scheduler_preset() is None
    assert config_class(device="cpu", lr_decay_share=0.2).get_scheduler_preset() == FinalDecayConfig(
        share=0.2
    )
    with pytest.raises(ValueError, match=r"lr_decay_share=1\.5"):
        config_class(device="cpu", lr_decay_share=1.5)
