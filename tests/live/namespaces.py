"""Two hosts with a cable between them, as network namespaces: no privilege is needed for them."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

HERE, THERE = "10.77.0.1", "10.77.0.2"
ROOT = Path(__file__).resolve().parents[2]


def refusal() -> str:
    """Why there can be no namespaces on this machine, or ""."""
    try:
        done = subprocess.run(
            ["unshare", "-Urn", "ip", "link", "add", "aa", "type", "veth", "peer", "name", "ab"],
            capture_output=True,
            text=True,
            check=False,
        )
    except FileNotFoundError as error:
        return f"{error.filename} is not installed"
    return done.stderr.strip()


def start_isolated(module: str, *arguments: str) -> "subprocess.Popen[str]":
    """A module of the tests as the program of a host of its own."""
    return subprocess.Popen(
        ["unshare", "-Urn", sys.executable, "-m", module, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@dataclass(frozen=True, slots=True)
class Cable:
    """From this host to the other one, `THERE`, which is the namespace of process `other`."""

    other: int

    def start_far(self, *command: str, **how: object) -> "subprocess.Popen[str]":
        """A program on the other host."""
        enter = ["nsenter", "-t", str(self.other), "-n", *command]
        return subprocess.Popen(enter, text=True, **how)  # type: ignore[call-overload]

    def pull(self) -> None:
        _ip("link", "set", "here", "down")

    def plug(self) -> None:
        _ip("link", "set", "here", "up")

    def slow(self, rate: str) -> None:
        """At most so much passes, as "2mbit", with a queue of 0.4 s."""
        limit = ["tbf", "rate", rate, "burst", "32kbit", "latency", "400ms"]
        subprocess.run(["tc", "qdisc", "replace", "dev", "here", "root", *limit], check=True)

    def quick(self) -> None:
        subprocess.run(["tc", "qdisc", "del", "dev", "here", "root"], check=True)


@contextmanager
def cable() -> Iterator[Cable]:
    """To another host, from within a namespace."""
    other = subprocess.Popen(["unshare", "-n", "sh", "-c", "echo; exec sleep 300"], stdout=-1)
    assert other.stdout is not None
    other.stdout.readline()
    try:
        _ip("link", "set", "lo", "up")
        _ip("link", "add", "here", "type", "veth", "peer", "name", "there", "netns", str(other.pid))
        _ip("addr", "add", f"{HERE}/24", "dev", "here")
        _ip("link", "set", "here", "up")
        for words in (
            ["addr", "add", f"{THERE}/24", "dev", "there"],
            ["link", "set", "there", "up"],
            ["link", "set", "lo", "up"],
        ):
            _ip(*words, before=["nsenter", "-t", str(other.pid), "-n"])
        yield Cable(other.pid)
    finally:
        other.kill()
        other.wait()
        other.stdout.close()


def _ip(*words: str, before: Sequence[str] = ()) -> None:
    subprocess.run([*before, "ip", *words], check=True)
