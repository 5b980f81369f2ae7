"""From the station's images to a ``View``: colour, depth, the pinhole model and the pose."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from tog_drake.errors import InputError
from tog_drake.values import Intrinsics, View


class Camera(LeafSystem):
    """Copies one colour-and-depth image into a ``View``.

    .. pydrake_system::

        name: Camera
        input_ports:
        - rgb_image
        - depth_image
        - X_WC
        output_ports:
        - view

    Depth that is too near (0), too far (inf) or missing (NaN) becomes 0, a hole.

    Raises:
        InputError: an image's size differs from that of the intrinsics (an image that has not
            arrived yet is 0×0).
    """

    def __init__(self, intrinsics: Intrinsics):
        super().__init__()
        self._intrinsics = intrinsics
        self._rgb = self.DeclareAbstractInputPort("rgb_image", Value(ImageRgba8U()))
        self._depth = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self._X_WC = self.DeclareAbstractInputPort("X_WC", Value(RigidTransform()))
        self.DeclareAbstractOutputPort(
            "view",
            alloc=lambda: Value(View.empty()),
            calc=self._CalcView,
            prerequisites_of_calc={port.ticket() for port in (self._rgb, self._depth, self._X_WC)},
        )

    def _CalcView(self, context: Context, output: Value) -> None:
        rgba = self._rgb.Eval(context).data
        depth = self._depth.Eval(context).data[..., 0]
        for name, image in (("colour", rgba), ("depth", depth)):
            self._check_size(name, image.shape)
        # np.where and the change of layout both copy: the images belong to the station.
        output.set_value(
            View(
                rgb=np.ascontiguousarray(rgba[..., :3]).copy(),
                depth=np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32),
                intrinsics=self._intrinsics,
                X_WC=self._X_WC.Eval(context).GetAsMatrix4(),
            )
        )

    def _check_size(self, name: str, shape: tuple[int, ...]) -> None:
        expected = (self._intrinsics.height, self._intrinsics.width)
        if shape[:2] != expected:
            raise InputError(
                f"the {name} image is {shape[1]}×{shape[0]} pixels, but the camera is set up for "
                f"{expected[1]}×{expected[0]}: make the camera's width and height agree with its "
                "intrinsics (0×0 means that no image has arrived yet)"
            )


def rendered_intrinsics(info: CameraInfo) -> Intrinsics:
    """Returns the pinhole model of the images that Drake renders for ``info``.

    Drake's renderer measures the principal point from the image's corner, half a pixel before the
    middle of the first pixel, from which ``Intrinsics`` counts; a test shows it.
    """
    return Intrinsics(
        width=info.width(),
        height=info.height(),
        fx=info.focal_x(),
        fy=info.focal_y(),
        cx=info.center_x() - 0.5,
        cy=info.center_y() - 0.5,
    )
