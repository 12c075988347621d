"""The `bnirl` command: one file for each subcommand, and what several of them share.

Here what is asked for is read from the command line, and what comes of it is printed; nothing else
is done here. A file imports what its command needs when that runs, so that `--help` is quick.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import sys
from collections.abc import Sequence

from bnirl_ros import __version__
from bnirl_ros.cli import bag, demo, infer, predict, record, replay, reproduce, waypoints
from bnirl_ros.cli.terminal import warn
from bnirl_ros.errors import InputError

COMMANDS = (bag, infer, predict, waypoints, reproduce, replay, record, demo)
"""The modules of the subcommands, in the order in which `--help` lists them; each has `add`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 1 for bad input, 2 for wrong arguments."""
    # A command lives so short that collecting garbage, while libraries are imported and again at
    # the end, would be a fifth of its time.
    gc.disable()
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        for command in (replay, record):  # their options are a node's, which argparse cannot know
            if given[:1] == [command.NAME]:
                return command.run(given[1:])
        options = parser().parse_args(_joined(given))
        return int(options.run(options))
    except InputError as error:
        warn(str(error))
        return 1
    except KeyboardInterrupt:
        print("bnirl: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read our output, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    finally:
        gc.freeze()
        gc.enable()


def parser() -> argparse.ArgumentParser:
    """All that the command line may say."""
    made = argparse.ArgumentParser(
        prog="bnirl", description="Tell what a demonstrator was going for."
    )
    made.add_argument("--version", action="version", version=f"bnirl {__version__}")
    commands = made.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return made


def _joined(arguments: Sequence[str]) -> list[str]:
    """The arguments, with a negative x after `--start`, which would be an option, joined to it."""
    joined: list[str] = []
    for word in arguments:
        if joined and joined[-1] == "--start" and re.match(r"-[\d.]", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined
