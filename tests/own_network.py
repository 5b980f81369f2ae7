"""Runs a program where there is no network but its own loopback, on which LCM's multicast works.

So it hears no other run, and no other computer hears it.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

_SETUP = "ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo"
needs_own_network = pytest.mark.skipif(
    shutil.which("ip") is None
    or subprocess.run(["unshare", "-rn", "true"], check=False, capture_output=True).returncode != 0,
    reason="needs network namespaces: apt-get install iproute2, and unshare -rn",
)


def in_own_network(*arguments, timeout=240):
    """Runs a Python program, with a folder of its own for ``tests``; returns what became of it."""
    return subprocess.run(
        ["unshare", "-rn", "sh", "-c", f'{_SETUP} && exec "$@"', "sh", sys.executable, "-B"]
        + [str(argument) for argument in arguments],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        cwd=Path(__file__).parent,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
