"""Whether a demonstration comes across a network that loses and delays packets.

    make campaigns
    python benchmarks/lossy_network.py --loss 20 --delay 100

Two network namespaces, each a host of its own, are joined by a relay that reads the packets of
both, throws some away and holds the others back. The demonstrator of benchmarks/load.py is in one,
the subgoal node and an observer in the other. It takes root, iproute2 and /dev/net/tun, and says
so where they are missing. Exit status 1 where an observation was lost.
"""

from __future__ import annotations

import argparse
import fcntl
import heapq
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

IP = shutil.which("ip") or ""  # of iproute2
HOSTS = ("bnirl_robot", "bnirl_desk")
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 65_536  # bytes at the most
PATIENCE = 300.0  # [s]


class Relay:
    """Carries packets between two hosts, some of them, and later."""

    def __init__(self, devices: tuple[int, int], loss: float, delay: float) -> None:
        """`devices`: opened; `loss`: share of packets; `delay`: [s]."""
        self.carried = self.lost = 0
        self._devices, self._loss, self._delay = devices, loss, delay
        self._random = random.Random(0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Carry nothing any more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        first, second = self._devices
        other = {first: second, second: first}
        held: list[tuple[float, int, int, bytes]] = []
        while not self._stop.is_set():
            now = time.monotonic()
            wait = max(0.0, held[0][0] - now) if held else 0.1
            for device in select.select(self._devices, [], [], wait)[0]:
                packet = os.read(device, _PACKET)
                if self._random.random() < self._loss:
                    self.lost += 1
                else:
                    self.carried += 1
                    due = time.monotonic() + self._delay
                    heapq.heappush(held, (due, self.carried, other[device], packet))
            while held and held[0][0] <= time.monotonic():
                _, _, device, packet = heapq.heappop(held)
                os.write(device, packet)


@contextmanager
def hosts() -> Iterator[tuple[int, int]]:
    """Two namespaces with a device each, whose packets can be read and written here."""
    with ExitStack() as stack:
        devices = []
        for number, host in enumerate(HOSTS, start=1):
            _ip("netns", "add", host)
            stack.callback(_ip, "netns", "del", host)
            device = os.open("/dev/net/tun", os.O_RDWR)
            stack.callback(os.close, device)
            name = f"bnirl{number}".encode()
            fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", name, _IFF_TUN | _IFF_NO_PI))
            devices.append(device)
            _ip("link", "set", name.decode(), "netns", host)
            inside = ("-n", host)
            _ip(*inside, "address", "add", f"10.99.0.{number}/24", "dev", name.decode())
            _ip(*inside, "link", "set", "lo", "up")
            _ip(*inside, "link", "set", name.decode(), "up", "multicast", "on")
            _ip(*inside, "route", "add", "224.0.0.0/4", "dev", name.decode())
        yield devices[0], devices[1]


def _ip(*words: str) -> None:
    subprocess.run([IP, *words], check=True)


def on(host: str, *words: str, home: str) -> subprocess.Popen[str]:
    """A process on one of the hosts, with the interpreter of this one."""
    environment = os.environ | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_DOMAIN_ID": "77",
        "ROS_HOME": home,
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",  # and no memory that both hosts share
    }
    return subprocess.Popen(
        [IP, "netns", "exec", host, sys.executable, *words],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )


def observe(observations: int) -> None:
    """Print how many observations the node has, once it has so many, and what it left out."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray

    health: dict[str, str] = {}

    def hear(message: Any) -> None:
        health.update({each.key: each.value for each in message.status[0].values})

    rclpy.init()
    node = rclpy.create_node("observer")
    node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
        if health.get("observations") == str(observations) and health.get("queue") == "0":
            break
    print(health.get("observations", "0"), health.get("drops", "0"), flush=True)


def main() -> int:
    """Print what came across; returns the exit status."""
    parser = argparse.ArgumentParser(description="Does a demonstration come across a bad network?")
    parser.add_argument("--loss", type=float, default=10.0, help="[%%] (%(default)s)")
    parser.add_argument("--delay", type=float, default=50.0, help="[ms] (%(default)s)")
    parser.add_argument("--seconds", type=float, default=30.0, help="(%(default)s)")
    parser.add_argument("--rate", type=float, default=250.0, help="observations (%(default)s)")
    parser.add_argument("--observe", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--send", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.observe is not None:
        observe(given.observe)
        return 0
    if given.send is not None:
        from load import send

        send(given.send, given.rate)
        return 0
    if os.geteuid() or not IP or not os.access("/dev/net/tun", os.W_OK):
        print("not tried: it takes root, iproute2 and /dev/net/tun")
        return 0
    observations = round(given.seconds * given.rate)
    robot, desk = HOSTS
    with tempfile.TemporaryDirectory() as home, hosts() as devices:
        relay = Relay(devices, given.loss / 100, given.delay / 1000)
        code = "from bnirl_ros.nodes.start import subgoal_node; subgoal_node()"
        words = ("--ros-args", "-p", "sweeps:=20", "-p", "burn_in:=10")
        node = on(desk, "-c", code, *words, home=home)
        observer = on(desk, __file__, "--observe", str(observations), home=home)
        begin = time.monotonic()
        sender = on(
            robot, __file__, "--send", str(observations), "--rate", str(given.rate), home=home
        )
        with suppress(subprocess.TimeoutExpired):
            sender.wait(PATIENCE)
        sent, status = time.monotonic() - begin, sender.poll()
        sender.kill()
        said, _ = observer.communicate()
        node.send_signal(signal.SIGINT)
        node.wait()
        relay.close()
    came, left_out = map(int, said.split())
    share = 100 * relay.lost / max(1, relay.lost + relay.carried)
    print(
        f"{relay.carried + relay.lost} packets, {share:.1f} % lost, the others "
        f"{given.delay:g} ms late: {came} of {observations} observations came across, "
        f"{left_out} messages left out; {'all' if status == 0 else 'not all'} acknowledged after "
        f"{sent:.0f} s, a demonstration of {given.seconds:g} s"
    )
    return int(status != 0 or came != observations or left_out != 0)


if __name__ == "__main__":
    sys.exit(main())
