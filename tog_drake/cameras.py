"""Camera presets: what a scenario says instead of focal lengths, ranges and noise.

Each describes a depth camera with depth aligned to colour, as its driver delivers it; with
``noise`` the simulated depth is as imperfect as that of the real one (``stations/depth_noise.py``).
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeAlias

import numpy as np
from pydrake.common.schema import Rotation, Transform
from pydrake.math import RotationMatrix
from pydrake.systems.sensors import CameraConfig

from tog_drake.errors import InputError


@dataclass(frozen=True)
class DepthNoise:
    """How the depth of a camera departs from the truth.

    Angles are what a length in the image is seen under: times the focal length it is in pixels.
    """

    sigma: tuple[float, float, float]  # [m], [1], [1/m]: σ(z) = s0 + s1 z + s2 z², z in m
    correlation: float  # [rad] neighbouring errors are alike: std of the Gaussian that blurs them
    quantum: float  # [m] depth is a multiple of this
    edge_width: float  # [rad] how far from a depth edge a pixel may still see both sides
    flying: float  # share of those pixels that lie somewhere between fore- and background
    edge_holes: float  # share of those pixels that are invalid
    raggedness: float  # [rad] std by which edges are displaced
    incidence: tuple[float, float]  # [rad] of ray and normal, where holes begin and all is hole
    baseline: float  # [m] from the imager to the second one at its right; 0: sees no shadow


@dataclass
class _Preset:
    resolution: str = "640x480"  # or 1280x720 [pixel]
    noise: bool = False  # depth as the real camera would measure it; else it is exact
    X_PB: Transform = field(
        default_factory=lambda: Transform(
            base_frame="hand::panda_hand",
            translation=[0.065, 0.0, 0.035],
            rotation=Rotation(RotationMatrix.MakeZRotation(np.pi / 2)),
        )
    )  # where it is mounted: beside the hand, looking along the fingers

    # By resolution: focal length of the colour image [pixel], least range [m], the noise.
    focal: ClassVar[dict[str, float]]
    z_near: ClassVar[dict[str, float]]
    depth_noise: ClassVar[dict[str, DepthNoise]]
    z_far: ClassVar[float]  # [m]

    def camera_config(self) -> CameraConfig:
        """Returns the same camera in Drake's terms, which know no noise.

        Raises:
            InputError: if the resolution is none of the camera's.
        """
        if self.resolution not in self.focal:
            raise InputError(
                f"{type(self).__name__} has no resolution {self.resolution!r}; valid: "
                + ", ".join(self.focal)
            )
        width, height = map(int, self.resolution.split("x"))
        focal = self.focal[self.resolution]
        return CameraConfig(
            width=width,
            height=height,
            focal=CameraConfig.FocalLength(x=focal, y=focal),
            z_near=self.z_near[self.resolution],
            z_far=self.z_far,
            clipping_near=0.01,
            X_PB=self.X_PB,
            depth=True,
        )


@dataclass
class L515(_Preset):
    """A camera like an Intel RealSense L515, a laser scanner: `!L515 {}`.

    Data sheet: colour 70° × 43° at 1280×720 (640×480 is the middle of it, scaled by 2/3), range
    0.25–9 m, depth unit 0.25 mm, standard deviation 2.5 mm at 1 m and 15.5 mm at 9 m on a white
    target, which a line through both puts at 1.7 mm at 0.5 m. A laser spot is taken to be as wide
    as a pixel of the native depth image (640 over 70°: 2.2 mrad), within which a return from two
    surfaces is mixed; its errors to be nearly independent. The share of flying pixels and the
    incidence at which returns fade are chosen, not measured: no frames of an L515 were at hand.
    """

    focal: ClassVar = {"1280x720": 914.1, "640x480": 609.4}
    z_near: ClassVar = {"1280x720": 0.25, "640x480": 0.25}
    z_far: ClassVar = 9.0
    depth_noise: ClassVar = dict.fromkeys(
        focal,
        DepthNoise(
            sigma=(0.0009, 0.0016, 0.0),
            correlation=0.0013,
            quantum=0.00025,
            edge_width=0.0022,
            flying=0.4,
            edge_holes=0.1,
            raggedness=0.0,
            incidence=(np.radians(72), np.radians(84)),
            baseline=0.0,
        ),
    )


def _stereo_noise(native_focal: float) -> DepthNoise:
    """The noise of a D435 whose imagers have that focal length [pixel]."""
    baseline, subpixel = 0.050, 0.12
    return DepthNoise(
        sigma=(0.0, 0.0, subpixel / (native_focal * baseline)),
        correlation=3.0 / native_focal,
        quantum=0.001,
        edge_width=3.0 / native_focal,
        flying=0.05,
        edge_holes=0.15,
        raggedness=1.0 / native_focal,
        incidence=(np.radians(74), np.radians(86)),
        baseline=baseline,
    )


@dataclass
class D435(_Preset):
    """A camera like an Intel RealSense D435, active stereo: `!D435 {}`.

    Data sheet: colour 69° × 42° at 1280×720 (640×480 is the middle of it, scaled by 2/3), least
    range 0.28 m at 1280×720 and 0.175 m at 640×480, baseline 50 mm, depth unit 1 mm; the imagers'
    90° (75° at 640×480) make focal lengths of 640 and 417 pixels. The noise of a plane is
    σ = z² · subpixel / (focal length · baseline) with a subpixel of 0.08 on good texture (Intel,
    "Tuning depth cameras for best performance"). On recorded tables (640×480, 0.6 m) we found
    1.8–2.2 mm about the plane, hence 0.12, and errors alike over 8 pixels of the colour image,
    which a blur of 3 imager pixels gives: the window that is matched. The shadow lies left of what
    casts it. What alignment to the colour imager, 15 mm aside, hides in addition is not modelled.
    """

    focal: ClassVar = {"1280x720": 931.2, "640x480": 620.8}
    z_near: ClassVar = {"1280x720": 0.28, "640x480": 0.175}
    z_far: ClassVar = 10.0
    depth_noise: ClassVar = {"1280x720": _stereo_noise(640.0), "640x480": _stereo_noise(417.0)}


Camera: TypeAlias = L515 | D435 | CameraConfig
"""What a scenario's ``cameras`` holds: a preset or, without noise, any camera in Drake's terms."""


def drake_config(camera: Camera) -> CameraConfig:
    """Returns the camera in Drake's terms.

    Raises:
        InputError: if a preset has no such resolution.
    """
    return camera if isinstance(camera, CameraConfig) else camera.camera_config()


def noise_of(camera: Camera) -> DepthNoise | None:
    """Returns the noise of the camera's depth image, None where it is exact."""
    if isinstance(camera, CameraConfig) or not camera.noise:
        return None
    return camera.depth_noise[camera.resolution]


def with_noise(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """Returns the same cameras, measuring depth with noise.

    Raises:
        InputError: if one is no preset: nobody knows how noisy it is.
    """
    for name, camera in cameras.items():
        if isinstance(camera, CameraConfig):
            raise InputError(
                f"camera {name} is given in Drake's terms, which know no noise; valid with noise: "
                "!L515 {}, !D435 {}"
            )
    return {
        name: replace(camera, noise=True)
        for name, camera in cameras.items()
        if not isinstance(camera, CameraConfig)
    }
