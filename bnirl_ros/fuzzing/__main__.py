"""Bad input for all doors: `python -m bnirl_ros.fuzzing --help`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from bnirl_ros.fuzzing.campaign import Account, campaign_of
from bnirl_ros.fuzzing.doors import doors
from bnirl_ros.fuzzing.guided import guided

INPUTS = 20_000
"""For each door."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all doors; returns the exit status: 1 where something else than a refusal happened."""
    parser = argparse.ArgumentParser(prog="fuzzing", description="Bad input for every door.")
    parser.add_argument("--inputs", type=int, default=INPUTS, help="for each (%(default)s)")
    parser.add_argument(
        "--guided",
        type=int,
        default=0,
        metavar="SECONDS",
        help="for each, then led by what code the input reaches, if above 0 (%(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    parser.add_argument("--only", default="", help="doors with this in their name")
    parser.add_argument(
        "--out", type=Path, default=Path("bnirl_out/faults"), help="for bad input (%(default)s)"
    )
    options = parser.parse_args(arguments)
    names = [door.name for door in doors() if options.only in door.name]
    print("| door | tried | accepted | refused | faults | slowest [s] | grew by [MB] |")
    print("|---|---|---|---|---|---|---|")
    wrong = 0
    spawned = get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), spawned, max_tasks_per_child=1) as pool:
        waiting = [pool.submit(campaign_of, name, options.inputs, options.seed) for name in names]
        for each in waiting:
            account = each.result()
            print(
                f"| {account.door} | {account.tried} | {account.accepted} | {account.refused} | "
                f"{len(account.faults)} | {account.slowest:.2f} | {account.memory / 1e6:.0f} |",
                flush=True,
            )
            wrong += len(account.faults)
            _keep(account, options.out)
    if options.guided:
        wrong += _guided(names, options.guided, options.out)
    return 1 if wrong else 0


def _guided(names: Sequence[str], seconds: int, out: Path) -> int:
    """Let a fuzzer look for faults that random changes do not find; returns how many it found."""
    print("\n| door | tried | branches reached | fault |\n|---|---|---|---|")
    wrong = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for found in pool.map(lambda name: guided(name, seconds, out), names):
            print(
                f"| {found.door} | {found.tried} | {found.reached} | {found.fault} |", flush=True
            )
            wrong += bool(found.fault) or not found.tried
    return wrong


def _keep(account: Account, folder: Path) -> None:
    """Write the input of faults, and say what they are."""
    for number, fault in enumerate(account.faults):
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{account.door.replace(' ', '_').replace('/', '_')}_{number}"
        file.write_bytes(fault.data)
        print(f"{file}: {fault.what}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
