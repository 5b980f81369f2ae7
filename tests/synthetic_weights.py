"""Weights by rule for Contact-GraspNet: not the released ones, yet with answers that vary.

The same rule as that of the parity fixture: every tensor is drawn from a generator of its own,
seeded by the CRC-32 of its name. ``python tests/synthetic_weights.py FILE`` writes a checkpoint.
"""

import sys
import zlib
from pathlib import Path

import numpy as np
import torch

from tog_drake.proposers.contact_graspnet.network import ContactGraspNet


def synthetic_state():
    """The state dict, in the order of the network's own."""
    shapes = {name: tuple(tensor.shape) for name, tensor in ContactGraspNet().state_dict().items()}
    return {name: torch.from_numpy(_draw(name, shape)) for name, shape in shapes.items()}


def synthetic_network(**options):
    """The network with these weights."""
    network = ContactGraspNet(**options)
    network.load_state_dict(synthetic_state())
    return network.eval()


def write_checkpoint(file):
    """Writes them as the published checkpoint is written: beside other things, under ``model``."""
    torch.save({"model": synthetic_state(), "epoch_it": 0, "it": 0}, file)


def _draw(name, shape):
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    if len(shape) >= 3:  # the kernel of a 1×1 convolution
        inputs = shape[1]
        if inputs == 6:  # coordinates are small numbers
            kernel = rng.standard_normal(shape) * (20 / np.sqrt(6))
        else:
            kernel = rng.standard_normal(shape) * (1.4 / np.sqrt(inputs))
            kernel -= kernel.mean(axis=1, keepdims=True)
        return kernel.astype(np.float32)
    if name.endswith((".bias", ".running_mean")):
        return (rng.standard_normal(shape) * 0.1).astype(np.float32)
    return rng.uniform(0.5, 1.5, shape).astype(np.float32)


if __name__ == "__main__":
    write_checkpoint(Path(sys.argv[1]))
