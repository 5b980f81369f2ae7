"""A picture with words below it, which stands in a Meshcat scene."""

import base64
import json
import textwrap
from collections.abc import Sequence

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from tog_drake.drawing import Image, encode_png
from tog_drake.portrait import blank, write_words
from tog_drake.values import Array
from tog_drake.visible_text import visible

WIDTH = 640  # [pixel] of the board, whatever the picture's
_INK, _SCALE, _STROKE, _LINE, _LETTERS, _MOST_LINES = (20, 20, 20), 0.75, 2, 30, 46, 8


def board_image(picture: Image | None, words: Sequence[str]) -> Image:
    """Returns the picture (H, W, 3), as wide as the board, with the words below it.

    What a model says is data: it is cut, and what cannot be drawn becomes a question mark.
    """
    import cv2

    plain = [visible(text, limit=600).encode("ascii", "replace").decode() for text in words]
    lines = [line for text in plain for line in textwrap.wrap(text, _LETTERS)][:_MOST_LINES]
    below = blank((WIDTH, _LINE * (_MOST_LINES + 1)))
    for number, line in enumerate(lines, 1):
        write_words(below, line, _LINE * number, _INK, _SCALE, stroke=_STROKE)
    if picture is None:
        return below
    height = round(picture.shape[0] * WIDTH / picture.shape[1])
    scaled = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.vstack([scaled.astype(np.uint8), below])


def set_billboard(meshcat: Meshcat, path: str, image: Image, p_W: Array, eye_W: Array) -> None:
    """Puts an image into the scene, 1 m wide, at ``p_W`` (3,) [m], facing ``eye_W`` (3,) [m]."""
    height = image.shape[0] / image.shape[1]
    file = MemoryFile(_gltf(encode_png(image), height).encode(), ".gltf", "billboard")
    meshcat.SetObject(path, Mesh(InMemoryMesh(mesh_file=file), np.ones(3)), Rgba(1, 1, 1, 1))
    normal = (eye_W - p_W) / np.linalg.norm(eye_W - p_W)
    right = np.cross([0.0, 0.0, 1.0], normal)
    right = right / np.linalg.norm(right)
    R_WB = RotationMatrix(np.column_stack([right, np.cross(normal, right), normal]))
    meshcat.SetTransform(path, RigidTransform(R_WB, p_W))


def _gltf(png: bytes, height: float) -> str:
    """A rectangle in x and y, 1 wide, with an image on it that no light changes (glTF 2.0).

    glTF's y is up, which is z for Meshcat: what is y there is written as −z here.
    """
    x, y = 0.5, height / 2
    corners = np.array([[-x, 0, y], [x, 0, y], [x, 0, -y], [-x, 0, -y]], np.float32)
    texture = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    triangles = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    parts = [array.tobytes() for array in (corners, texture, triangles)]
    begins = np.cumsum([0, *map(len, parts)])
    content = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
                        "indices": 2,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0},
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": _data_url("image/png", png)}],
        "buffers": [
            {
                "byteLength": int(begins[-1]),
                "uri": _data_url("application/octet-stream", b"".join(parts)),
            }
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(begin), "byteLength": len(part)}
            for begin, part in zip(begins, parts, strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": corners.min(axis=0).tolist(),
                "max": corners.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }
    return json.dumps(content)


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
