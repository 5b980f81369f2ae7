"""Whether this machine can render camera images, asked before VTK tries and crashes.

Drake's VTK engine draws through EGL, which needs no display. A missing libEGL is an exception
there, but a missing *driver* behind it is a segmentation fault at the first image; so EGL is
asked here, with the calls that VTK will make.
"""

import ctypes
import sys
import time
from collections.abc import Sequence
from functools import cache

from pydrake.geometry import (
    LightParameter,
    MakeRenderEngineVtk,
    RenderEngine,
    RenderEngineVtkParams,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraConfig, RgbdSensor

from tog_drake.errors import InputError

_EGL_PLATFORM_DEVICE_EXT = 0x313F  # from the EGL_EXT_platform_device specification
_INSTALL = "install it with: sudo apt-get install libegl1 libgl1-mesa-dri"


def make_render_engine(background: Rgba, lights: Sequence[LightParameter] = ()) -> RenderEngine:
    """Returns Drake's VTK engine.

    Args:
        background: where nothing is.
        lights: none: one at the camera. With some, every scene is lit in the same way; else one
            with glTF meshes is darker, as VTK then draws all by physically based rendering.

    Raises:
        InputError: if this machine cannot render; the message names the package to install.
    """
    problem = rendering_problem()
    if problem:
        raise InputError(f"cannot render camera images: {problem}")
    backend = "EGL" if sys.platform == "linux" else ""
    return MakeRenderEngineVtk(
        RenderEngineVtkParams(
            default_clear_color=background.rgba[:3],
            lights=list(lights),
            backend=backend,
            force_to_pbr=bool(lights),
        )
    )


@cache
def rendering_problem() -> str | None:
    """Returns what keeps this machine from rendering and how to mend it, or None."""
    if sys.platform != "linux":
        return None  # macOS renders through Cocoa, which is always there
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return f"the system library libEGL.so.1 is missing; {_INSTALL}"
    if not any(_initializes(egl, display) for display in _displays(egl)):
        return f"EGL finds no graphics driver (a software one is enough); {_INSTALL}"
    return None


def _displays(egl: ctypes.CDLL) -> list[int]:
    """The displays that VTK would try: one for each device, then the default."""
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetDisplay.restype = ctypes.c_void_p
    displays = []
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    open_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if query and open_display:
        query_devices = ctypes.CFUNCTYPE(
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.POINTER(ctypes.c_void_p),
            ctypes.POINTER(ctypes.c_int),
        )(query)
        platform_display = ctypes.CFUNCTYPE(
            ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
        )(open_display)
        devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int(0)
        if query_devices(16, devices, ctypes.byref(count)):
            for device in devices[: count.value]:
                displays.append(platform_display(_EGL_PLATFORM_DEVICE_EXT, device, None))
    displays.append(egl.eglGetDisplay(None))
    return [display for display in displays if display]


def _initializes(egl: ctypes.CDLL, display: int) -> bool:
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    egl.eglInitialize.restype = ctypes.c_uint
    return bool(egl.eglInitialize(display, None, None))


def render_probe() -> str:
    """Renders one image of an empty world and says how long it took."""
    start = time.perf_counter()
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    scene_graph.AddRenderer("probe", make_render_engine(Rgba(1, 1, 1, 1)))
    color, depth = CameraConfig(renderer_name="probe", width=64, height=48).MakeCameras()
    sensor = builder.AddSystem(
        RgbdSensor(
            scene_graph.world_frame_id(), RigidTransform(), color_camera=color, depth_camera=depth
        )
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    diagram = builder.Build()
    context = sensor.GetMyContextFromRoot(diagram.CreateDefaultContext())
    image = sensor.color_image_output_port().Eval(context)
    return f"first {image.width()}×{image.height()} image after {time.perf_counter() - start:.1f} s"
