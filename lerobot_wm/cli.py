"""The `lerobot-wm` command: a table of subcommands, each a module with a `main()`."""

import importlib
import re
import sys
from os.path import expanduser

from lerobot.configs.parser import (
    PLUGIN_DISCOVERY_SUFFIX,
    PluginLoadError,
    filter_arg,
    load_plugin,
    parse_plugin_args,
)
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wm.errors import exit_with_one_line
from lerobot_wm.system import hide_harmless_messages

# Name -> (module whose main() reads sys.argv, what it does).
COMMANDS: dict[str, tuple[str, str]] = {
    "collect": ("lerobot_wm.collect.command", "scripted-expert Meta-World demonstrations -> LeRobotDataset"),
    "expert": ("lerobot_wm.commands.expert", "rollouts of the scripted expert -> records"),
    "repair": ("lerobot_wm.commands.repair", "copy of a LeRobot 2 or wrongly timed dataset, repaired"),
    "rename": ("lerobot_wm.commands.rename", "copy of a dataset with other names for its features"),
    "init": ("lerobot_wm.commands.init", "checkpoint of an untrained world model or a frozen image backbone"),
    "train": ("lerobot_wm.train.command", "lerobot-train with its flags, fed from RAM or GPU memory"),
    "encode": ("lerobot_wm.encode.command", "image dataset + frozen world model -> latent LeRobotDataset"),
    "eval": ("lerobot_wm.evaluate.command", "lerobot-eval with its flags, one record per rollout"),
    "report": (
        "lerobot_wm.report.command",
        "data, curves, dreams, replay, records -> self-contained HTML page",
    ),
    "quality": ("lerobot_wm.inspect.quality", "how good a world model is on unseen positions"),
    "dream": (
        "lerobot_wm.inspect.dream",
        "an episode as a world model imagines it -> video and strip",
    ),
    "replay": ("lerobot_wm.inspect.replay", "how far a policy is from recorded actions, without a robot"),
    "publish": ("lerobot_wm.commands.publish", "checkpoint -> the Hub, with results and a dream on its card"),
    "doctor": ("lerobot_wm.commands.doctor", "check Python, GL, packages, GPU, disk and Hub login"),
}


def usage() -> str:
    """The text of `lerobot-wm --help`."""
    lines = ["usage: lerobot-wm COMMAND [flags]    (lerobot-wm COMMAND --help lists a command's flags)", ""]
    lines += [f"  {name:<9}{what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(lines)


def load_plugins(arguments: list[str]) -> list[str]:
    """Register the types of installed plug-ins, and of packages named by a flag.

    Args:
        arguments: Arguments of the command; `--discover_packages_path=PACKAGE`, with any prefix, names a package.

    Returns:
        The other arguments.

    Raises:
        PluginLoadError: A package is missing or cannot be imported.
    """
    register_third_party_plugins()
    for flag, package in parse_plugin_args(PLUGIN_DISCOVERY_SUFFIX, arguments).items():
        load_plugin(package)
        arguments = filter_arg(flag, arguments)
    return arguments


def expand_home(argument: str) -> str:
    """`--flag=~/path`, or a list of paths, with the home folder in place of `~`, which shells do not expand there."""
    if not argument.startswith("--"):
        return argument
    return re.sub(r"(?<=[=,[])~[\w.-]*(?=/|$)", lambda found: expanduser(found[0]), argument)


def main() -> None:
    """Run the subcommand that the command line names first."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        print(usage())
        return
    if name not in COMMANDS:
        sys.exit(f"lerobot-wm: unknown command '{name}'; expected one of {', '.join(COMMANDS)}.")
    hide_harmless_messages()
    with exit_with_one_line(f"lerobot-wm {name}"):
        try:
            arguments = load_plugins(list(map(expand_home, sys.argv[2:])))
        except PluginLoadError as error:
            sys.exit(f"lerobot-wm {name}: {error}")
        # LeRobot's parsers read sys.argv.
        sys.argv = [f"lerobot-wm {name}", *arguments]
        importlib.import_module(COMMANDS[name][0]).main()


if __name__ == "__main__":
    main()
