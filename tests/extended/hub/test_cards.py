"""Cards show names of any kind correctly."""

import pytest
from huggingface_hub import ModelCard
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from markdown_it import MarkdownIt

from lerobot_wm.commands.publish import check_records
from lerobot_wm.constants import MT6
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.markdown import code, escaped
from lerobot_wm.policies.common.card import TrainingData, eval_command, model_card
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.records import Record
from lerobot_wm.world_model.config import RSSMConfig

NASTY = [
    "---\nlicense: mit\n---",
    "a | b",
    "<img src=x>",
    "`rm -rf`",
    "**bold** [link](http://x)",
    'it\'s "quoted"',
]
RECORD: Record = {
    "arm": "wm_bc",
    "policy_type": "wm_bc",
    "preset": "test",
    "seed": 0,
    "task": "reach-v3",
    "variation": 0,
    "seen": True,
    "success": True,
    "steps": 1,
    "return": 1.0,
}


def html(markdown: str) -> str:
    return MarkdownIt("gfm-like", {"linkify": False}).render(markdown)


@pytest.mark.parametrize("text", [*NASTY, "snake_case _edge_ ~x~ # y"])
def test_text_is_shown_as_it_is(text: str) -> None:
    shown = html(f"| x |\n|---|\n| {escaped(text)} |\n")
    plain = " ".join(text.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert f"<td>{plain.replace(chr(34), '&quot;')}</td>" in shown
    assert escaped("snake_case") == "snake_case"
    assert html(f"| x |\n|---|\n| {code(text)} |\n").count("<td><code>") == 1


def test_no_name_breaks_a_card() -> None:
    config = WMRSSMConfig(device="cpu", image_key="observation.image")
    config.input_features = features("VISUAL", "observation.image", (3, 64, 64))
    config.output_features = features("ACTION", "action", (4,))
    run = TrainPipelineConfig(dataset=DatasetConfig(repo_id="user/x"), policy=config)
    data = TrainingData("user/x", 2, 100, 30, NASTY[0], NASTY, "0123456789abcdef", None)
    card = model_card(config, "user/wm", run, data, imagined_tasks=NASTY)
    again = ModelCard(str(card))
    assert again.data.license == "apache-2.0"
    shown = html(again.text)
    assert "<img src=x>" not in shown
    assert "<strong>bold</strong>" not in shown
    [row] = [line for line in again.text.splitlines() if line.startswith("| tasks |")]
    assert "<table>" in shown
    assert len(html(f"| | |\n|---|---|\n{row}\n").split("<td>")) == 3


def features(kind: str, key: str, shape: tuple[int, ...]) -> dict:
    return {key: PolicyFeature(FeatureType[kind], shape)}


REACH, DOOR = "Reach a goal position", "Open a door with a revolving joint"
META_WORLD = "lerobot-wm eval --policy.path=user/x --env.type=metaworld_mt"


@pytest.mark.parametrize(
    ("tasks", "cameras", "size", "command"),
    [
        ([REACH], ["observation.image"], 64, f"{META_WORLD} --env.task=reach-v3 --eval"),
        (
            [REACH, DOOR],
            ["observation.images.hand_top", "observation.images.hand_side"],
            64,
            f"{META_WORLD} --env.task=reach-v3,door-open-v3 --env.camera_name=hand_top,hand_side --eval",
        ),
        (
            [REACH],
            ["observation.image"],
            480,
            f"{META_WORLD} --env.task=reach-v3 --env.image_size=480 --eval",
        ),
        (
            [task_description(task) for task in MT6],
            ["observation.image"],
            64,
            f"{META_WORLD} --env.task=mt6 --eval",
        ),
        (
            ["Wipe"],
            ["observation.image"],
            64,
            "lerobot-eval --policy.path=user/x --env.type=ENVIRONMENT --eval",
        ),
        (
            [REACH],
            ["observation.images.wrist"],
            64,
            "lerobot-eval --policy.path=user/x --env.type=ENVIRONMENT",
        ),
    ],
)
def test_the_command_evaluates_where_the_policy_was_trained(
    tasks: list[str], cameras: list[str], size: int, command: str
) -> None:
    config = WMBCConfig(device="cpu", tasks=tasks)
    config.input_features = {}
    for camera in cameras:
        config.input_features |= features("VISUAL", camera, (3, size, size))
    assert eval_command(config, "user/x").startswith(command)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"arm": "wm_iql"}, "arm wm_iql"),
        ({"policy_type": "wm_iql"}, "wm_iql"),
        ({"seed": 1}, "seed 1"),
    ],
)
def test_records_of_another_policy_are_refused(other: dict, said: str) -> None:
    check_records([RECORD], "wm_bc", 0)
    with pytest.raises(ValueError, match=said):
        check_records([RECORD, {**RECORD, **other}], "wm_bc", 0)


@pytest.mark.parametrize("is_target", [True, False])
def test_how_targets_were_learned_is_on_the_card(is_target: bool) -> None:
    rssm = RSSMConfig(hidden_action_share=0.25 if is_target else 0.0)
    world_model = WMRSSMConfig(device="cpu", image_key="observation.image", rssm=rssm)
    config = WMBCConfig(device="cpu", world_model=world_model, relative_indices=[0, 2] if is_target else [])
    config.input_features = features("VISUAL", "observation.image", (3, 64, 64))
    config.output_features = features("ACTION", "action", (3,))
    world_model.input_features, world_model.output_features = config.input_features, config.output_features
    for of, facts in ((config, ("2 of the action's 3", "25%")), (world_model, ("25%",))):
        card = str(model_card(of, "user/x", None, None))
        assert [fact in card for fact in facts] == [is_target] * len(facts)


def test_a_backbones_card_names_what_it_reads() -> None:
    """Its configuration keeps the dataset's other features."""
    config = FrozenBackboneConfig(device="cpu", image_key="observation.image")
    config.input_features = features("VISUAL", "observation.image", (3, 64, 64))
    config.input_features |= features("STATE", "observation.state", (4,))
    config.output_features = features("ACTION", "action", (4,))
    card = model_card(config, "user/resnet", None, None)
    inputs = str(card).split("| input | shape |")[1].split("\n\n")[0]
    assert "observation.image" in inputs
    assert "observation.state" not in inputs
