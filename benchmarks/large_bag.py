"""How much memory bags larger than it take: 2 GiB, in chunks of any size, and compressed.

    make benchmark
    python benchmarks/large_bag.py --megabytes 200

Reads each with `bnirl bag info`, which goes through all messages in the order of time, and plays
one as fast as it goes. Exit status 1 where more memory is taken than allowed, or a message lost.
Needs three times the size on the disk, in TMPDIR.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from bnirl_ros.bags.definitions import message_definition

MEMORY_BOUND = 300.0  # [MiB]
TYPE = "nav_msgs/msg/OccupancyGrid"
MESSAGE = 2**18  # bytes
MEGABYTE = 2**20
HZ = 100

# Size of the chunks [MiB], None for one in all, and how they and the file are compressed.
LAYOUTS: dict[str, tuple[int | None, CompressionType, bool]] = {
    "chunks of 1 MiB": (1, CompressionType.NONE, False),
    "chunks of 64 MiB, lz4": (64, CompressionType.LZ4, False),
    "one chunk, zstd": (None, CompressionType.ZSTD, False),
    "chunks of 1 MiB, file in zstd": (1, CompressionType.NONE, True),
}


def write(path: Path, megabytes: int, layout: str) -> int:
    """Write so much into a file; returns the number of messages, which hardly compress."""
    chunk, compression, whole = LAYOUTS[layout]
    count = megabytes * MEGABYTE // MESSAGE
    blocks = np.random.default_rng(0).bytes(MESSAGE * 32)
    size = (chunk or megabytes) * MEGABYTE
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=size, compression=compression)
        writer.start(profile="ros2", library="large_bag")
        schema = writer.register_schema(TYPE, "ros2msg", message_definition(TYPE).encode())
        channel = writer.register_channel("/map", "cdr", schema)
        for number in range(count):
            start = MESSAGE * (number % 32)
            log_time = (number + 1) * 10**9 // HZ
            data = blocks[start : start + MESSAGE]
            writer.add_message(channel, log_time, data, log_time)
        writer.finish()  # type: ignore[no-untyped-call]
    if whole:
        packed = path.with_name(f"{path.name}.zstd")
        with path.open("rb") as stream, packed.open("wb") as out:
            zstandard.ZstdCompressor(1).copy_stream(stream, out)
        path.unlink()
    return count


def run(*arguments: str) -> tuple[str, float, float]:
    """What a command of bnirl says, how long it takes [s], and its largest memory [MiB]."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile("w+") as out:
        command = [sys.executable, "-m", "bnirl_ros.cli", *arguments]
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        passed = time.perf_counter() - begin
        out.seek(0)
        said = out.read()
    if process.returncode:
        sys.exit(f"bnirl {' '.join(arguments)} ended with {process.returncode}:\n{said}")
    return said, passed, used.ru_maxrss / 1024


def main() -> int:
    """Print a line for each layout; returns the exit status."""
    parser = argparse.ArgumentParser(description="How much memory do large bags take?")
    parser.add_argument("--megabytes", type=int, default=2048, help="size (%(default)s MiB)")
    size = parser.parse_args().megabytes
    os.environ |= {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    broken = False
    print(f"{f'bag of {size} MiB':45} {'[s]':>8} {'[MiB]':>8}  at most {MEMORY_BOUND:g} MiB")
    for layout in LAYOUTS:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "large.mcap")
            with multiprocessing.get_context("spawn").Pool(1) as writer:
                # A process begins with the memory of its parent, which must be little.
                count = writer.apply(write, (path, size, layout))
            commands: dict[str, tuple[str, ...]] = {f"bag info, {layout}": ("bag", "info", folder)}
            if layout.startswith("chunks of 64"):
                commands[f"replay, {layout}"] = ("replay", folder, "--fast", "--wait", "1")
            for what, arguments in commands.items():
                said, passed, memory = run(*arguments)
                is_whole = f"{count} messages" in said
                holds = is_whole and memory <= MEMORY_BOUND
                broken |= not holds
                lost = "" if is_whole else f"  not all of {count} messages"
                print(
                    f"{what:45} {passed:8.1f} {memory:8.0f}{lost}{'' if holds else '  BROKEN'}",
                    flush=True,
                )
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
