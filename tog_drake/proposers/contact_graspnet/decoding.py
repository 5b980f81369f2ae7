"""From the heads' numbers at each contact to a pose of the hand."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

FINGER_DEPTH = 0.1034  # [m] from the hand's base to the line between the contacts, along z

BIN_WIDTHS = (
    *(0.003972176645, 0.011916527695, 0.0198608765, 0.02780522525, 0.035749574),
    *(0.0436939228, 0.0516382716, 0.0595826204, 0.06752696915, 0.075),
)
"""[m] The width that each of the ten bins stands for: its middle; of the last one its upper edge
0.08, less the 0.005 by which the hand opens wider than the thing."""


def widths(logits: Tensor) -> Tensor:
    """The width [m] (...) of the most likely bin, the first of equals; logits are (..., 10)."""
    return torch.tensor(BIN_WIDTHS, dtype=logits.dtype, device=logits.device)[logits.argmax(-1)]


def hand_poses(contact: Tensor, closing: Tensor, approach: Tensor, width: Tensor) -> Tensor:
    """Poses of the hand whose one finger is at the contact and whose other is ``width`` away.

    The hand's axes: x along ``closing``, from the contact to the other finger; z along what of
    ``approach`` is perpendicular to it; y = z × x. Its origin is its base, ``FINGER_DEPTH`` behind
    the middle between the fingers.

    Args:
        contact: (..., 3) [m].
        closing: (..., 3) of any length.
        approach: (..., 3) of any length.
        width: (...) [m].

    Returns:
        (..., 4, 4) in the frame of the contacts. A vector of no length stays zero; such a pose is
        no rotation.
    """
    x = normalize(closing, dim=-1)
    z = normalize(approach - (approach * x).sum(-1, keepdim=True) * x, dim=-1)
    y = torch.linalg.cross(z, x, dim=-1)
    origin = contact + width[..., None] / 2 * x - FINGER_DEPTH * z
    pose = torch.zeros((*contact.shape[:-1], 4, 4), dtype=contact.dtype, device=contact.device)
    pose[..., :3, :] = torch.stack([x, y, z, origin], dim=-1)
    pose[..., 3, 3] = 1
    return pose
