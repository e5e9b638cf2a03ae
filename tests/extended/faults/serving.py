"""A process that has imported what commands need, once, and forks for each it is told on its standard input."""

import json
import os
import signal
import sys


def serve() -> None:
    """Fork for each request to run a command, and answer with its process; tell the exit code of one waited for."""
    # What takes seconds to import; no import starts a thread, which a fork would not take along.
    import lerobot_wm.collect.command
    import lerobot_wm.encode.command
    import lerobot_wm.evaluate.command
    import lerobot_wm.train.command  # noqa: F401
    from lerobot_wm import cli

    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            answer = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
        else:
            answer = os.fork()
            if answer == 0:
                os.setpgid(0, 0)
                # A shell has what it puts into the background ignore Ctrl-C: tests that run there, too.
                signal.signal(signal.SIGINT, signal.default_int_handler)
                output = os.open(request["output"], os.O_WRONLY | os.O_CREAT)
                os.dup2(output, 1)
                os.dup2(output, 2)
                os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
                os.environ.update(request["environment"])
                sys.argv = ["lerobot-wm", *request["run"]]
                cli.main()
                return
            os.setpgid(answer, answer)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    serve()
