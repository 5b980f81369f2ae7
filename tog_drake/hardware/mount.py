"""The camera's mount in a scenario: read from it, and written into its file, the rest untouched."""

import numpy as np
import yaml
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from tog_drake.cameras import drake_config
from tog_drake.errors import InputError
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import Array

HAND_FRAME = "hand::panda_hand"


def mount_of(scenario: Scenario, camera: str) -> Array:
    """Returns X_HC (4, 4), where the scenario says that a camera sits on the hand.

    Raises:
        InputError: there is no such camera, or it is not on the hand.
    """
    if camera not in scenario.cameras:
        raise InputError(f"unknown camera {camera!r}; valid: {', '.join(scenario.cameras)}")
    config = drake_config(scenario.cameras[camera])
    if config.X_PB.base_frame != HAND_FRAME:
        raise InputError(
            f"camera {camera} is mounted on {config.X_PB.base_frame or 'the world'}; a mount on "
            f"the hand has X_PB: {{base_frame: {HAND_FRAME}, ...}}"
        )
    X_HC: Array = (config.X_PB.GetDeterministicValue() @ _X_BC(scenario, camera)).GetAsMatrix4()
    return X_HC


def with_mount(text: str, source: str, camera: str, X_HC: Array) -> str:
    """Returns the text of a scenario file with another mount of a camera, all else as it was.

    Args:
        text: of the file.
        source: its name, for messages.
        camera: whose mount it is; the file must name it under ``cameras``.
        X_HC: (4, 4) the camera at the hand's body.

    Raises:
        InputError: the file does not say anything of that camera, or not in a way that a mount
            could be put into.
    """
    scenario = parse_scenario(text, source, Scenario())
    mount_of(scenario, camera)
    X_PB = RigidTransform(X_HC) @ _X_BC(scenario, camera).inverse()
    written = _replaced(text, source, camera, _flow(X_PB.GetAsMatrix4()))
    moved = mount_of(parse_scenario(written, source, Scenario()), camera)
    if not np.allclose(moved, X_HC, atol=1e-5):
        raise InputError(f"{source}: the mount of {camera} cannot be put in; write it as one line")
    return written


def _X_BC(scenario: Scenario, camera: str) -> RigidTransform:
    core = drake_config(scenario.cameras[camera]).MakeCameras()[0].core()
    return core.sensor_pose_in_camera_body()


def _flow(X_PB: Array) -> str:
    """A `Transform` on one line: to a micrometre and to 1e-5 degrees."""
    place = ", ".join(f"{x:.6f}" for x in X_PB[:3, 3])
    turn = ", ".join(f"{a:.5f}" for a in Rotation.from_matrix(X_PB[:3, :3]).as_euler("xyz", True))
    return (
        f'{{base_frame: "{HAND_FRAME}", translation: [{place}], rotation: !Rpy {{deg: [{turn}]}}}}'
    )


def _replaced(text: str, source: str, camera: str, mount: str) -> str:
    """The text with ``mount`` in the place of the camera's X_PB, or as its first field."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    node = _field(_field(node, "cameras"), camera)
    if not isinstance(node, yaml.MappingNode):
        raise InputError(
            f"{source} says nothing of camera {camera}: add `cameras: {{{camera}: !L515 {{}}}}`, "
            "with the camera that it is (!L515, !D435, !CameraConfig)"
        )
    old = _field(node, "X_PB")
    if old is not None:
        return text[: old.start_mark.index] + mount + text[_end(old) :]
    if node.flow_style:
        brace = text.index("{", node.start_mark.index) + 1
        return f"{text[:brace]}X_PB: {mount}{', ' if node.value else ''}{text[brace:]}"
    first = node.value[0][0].start_mark
    return f"{text[: first.index]}X_PB: {mount}\n{' ' * first.column}{text[first.index :]}"


def _field(node: yaml.Node | None, key: str) -> yaml.Node | None:
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for name, value in node.value if name.value == key), None)


def _end(node: yaml.Node) -> int:
    """Where a node ends; PyYAML counts what follows a block, comments too, as part of it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)
