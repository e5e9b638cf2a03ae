"""A machine of its own, with an HF_HOME that may be emptied: runs commands in processes forked from one.

LeRobot takes ten seconds to import, and reads HF_HOME and HF_ENDPOINT while it does: so one process imports it, and
each command runs in a fork. Reads requests, one JSON object per line; answers each with the command's exit status.
"""

import json
import os
import shutil
import sys
import traceback

import httpx
import torch
from huggingface_hub import constants, set_client_factory

import lerobot_wm.collect.command
import lerobot_wm.commands.publish
import lerobot_wm.encode.command
import lerobot_wm.evaluate.command
import lerobot_wm.train.command  # noqa: F401  (all imported for the forks)
from lerobot_wm import cli

HUB = httpx.URL(constants.ENDPOINT)


class Loopback(httpx.HTTPTransport):
    """Reaches nothing but the Hub of the test, also where huggingface_hub asks the real one, to validate a card."""

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if request.url.host == "huggingface.co":
            request.url = request.url.copy_with(scheme=HUB.scheme, host=HUB.host, port=HUB.port)
        if request.url.host != HUB.host:
            raise AssertionError(f"A request would have left the machine: {request.url}")
        return super().handle_request(request)


def run(request: dict) -> None:
    """Run a command in this process, a fork, as the shell would."""
    with open(request["output"], "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    os.environ.update(request["env"])
    try:
        if "python" in request:
            exec(request["python"], {"__name__": "__main__"})
        else:
            sys.argv = ["lerobot-wm", *request["arguments"]]
            cli.main()
        status = 0
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
        if isinstance(error.code, str):
            print(error.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def main() -> None:
    torch.set_num_threads(1)
    set_client_factory(lambda: httpx.Client(transport=Loopback(), trust_env=False, timeout=30))
    answers = os.fdopen(os.dup(1), "w")
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if request["empty_home"]:
            shutil.rmtree(constants.HF_HOME, ignore_errors=True)
        child = os.fork()
        if child == 0:
            run(request)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)


if __name__ == "__main__":
    main()
