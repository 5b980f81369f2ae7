"""Types a block of README.md into a shell, in a network with the server that the block names.

The model there is ``seeing_server``, in the place of the one that a reader would serve.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
from canary_model import seeing
from seeing_server import see_and_answer
from vlm_server import VlmServer

from tog_drake.selectors.vlm.canary import draw_canary

PORT, FAMILY = 8000, "qwen3-vl"  # of the server and the model that README.md names


def answer(text, images):
    if np.array_equal(images[-1], draw_canary(0).image):
        return seeing(FAMILY)(text, images)
    return see_and_answer(text, images, FAMILY)


def main(script, folder):
    with VlmServer(answer, key=None, model="Qwen/Qwen3-VL-8B-Instruct", port=PORT):
        command = ["bash", "-euo", "pipefail", script]
        return subprocess.run(command, cwd=folder, stdin=subprocess.DEVNULL, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
