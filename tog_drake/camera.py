"""From the station's images to views: colour, depth, the pinhole model and the pose."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, InputPort, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from tog_drake.errors import InputError
from tog_drake.values import CameraView, Intrinsics, View


class Camera(LeafSystem):
    """Copies the colour-and-depth images of one camera or several into views.

    .. pydrake_system::

        name: Camera
        input_ports:
        - "{camera}.rgb_image"
        - "{camera}.depth_image"
        - "{camera}.X_WC"
        - earlier_views
        output_ports:
        - view
        - views

    ``view`` is that of the first camera, the pipeline's own; ``views`` are those of all, a tuple of
    ``CameraView`` in their order. What nobody asks for is not rendered. ``earlier_views``, which
    ``views`` ends with, is there only where the own camera takes further looks (``looks_again``).

    Depth that is too near (0), too far (inf) or missing (NaN) becomes 0, a hole.

    Args:
        cameras: the intrinsics by the cameras' names, the pipeline's own first.
        looks_again: whether there may be earlier views of the own camera.

    Raises:
        InputError: an image's size differs from that of the intrinsics (an image that has not
            arrived yet is 0×0).
    """

    def __init__(self, cameras: Mapping[str, Intrinsics], *, looks_again: bool = False):
        super().__init__()
        self._cameras = dict(cameras)
        self._ports = {name: self._declare_inputs(name) for name in self._cameras}
        tickets = [{port.ticket() for port in ports} for ports in self._ports.values()]
        self._earlier: InputPort | None = None
        if looks_again:
            self._earlier = self.DeclareAbstractInputPort("earlier_views", Value(()))
            tickets.append({self._earlier.ticket()})
        self._view = self.DeclareAbstractOutputPort(
            "view",
            alloc=lambda: Value(View.empty()),
            calc=self._CalcView,
            prerequisites_of_calc=tickets[0],
        )
        self.DeclareAbstractOutputPort(
            "views",
            alloc=lambda: Value(()),
            calc=self._CalcViews,
            prerequisites_of_calc=set().union(*tickets),
        )

    def _declare_inputs(self, camera: str) -> tuple[InputPort, InputPort, InputPort]:
        return (
            self.DeclareAbstractInputPort(f"{camera}.rgb_image", Value(ImageRgba8U())),
            self.DeclareAbstractInputPort(f"{camera}.depth_image", Value(ImageDepth32F())),
            self.DeclareAbstractInputPort(f"{camera}.X_WC", Value(RigidTransform())),
        )

    def _CalcView(self, context: Context, output: Value) -> None:
        output.set_value(self._view_of(next(iter(self._cameras)), context))

    def _CalcViews(self, context: Context, output: Value) -> None:
        own, *others = self._cameras
        views = [CameraView(own, self._view.Eval(context))]
        views += [CameraView(name, self._view_of(name, context)) for name in others]
        earlier = () if self._earlier is None else self._earlier.Eval(context)
        output.set_value((*views, *earlier))

    def _view_of(self, camera: str, context: Context) -> View:
        rgb_port, depth_port, X_WC_port = self._ports[camera]
        rgba = rgb_port.Eval(context).data
        depth = depth_port.Eval(context).data[..., 0]
        for kind, image in (("colour", rgba), ("depth", depth)):
            self._check_size(camera, kind, image.shape)
        # np.where and the change of layout both copy: the images belong to the station.
        return View(
            rgb=np.ascontiguousarray(rgba[..., :3]).copy(),
            depth=np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32),
            intrinsics=self._cameras[camera],
            X_WC=X_WC_port.Eval(context).GetAsMatrix4(),
        )

    def _check_size(self, camera: str, kind: str, shape: tuple[int, ...]) -> None:
        intrinsics = self._cameras[camera]
        expected = (intrinsics.height, intrinsics.width)
        if shape[:2] != expected:
            raise InputError(
                f"{camera}: the {kind} image is {shape[1]}×{shape[0]} pixels, but the camera is "
                f"set up for {expected[1]}×{expected[0]}: make the camera's width and height agree "
                "with its intrinsics (0×0 means that no image has arrived yet)"
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
