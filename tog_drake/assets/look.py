"""What a stranger's mesh looks like, brought to two forms: a texture, or the colours of vertices.

Both are in sRGB here, as in photographs. glTF has textures in sRGB, but all other colours linear.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

GREY = (160, 160, 160)

Look = tuple[Any, Any, tuple[int, int, int], NDArray[np.uint8] | None]
"""Texture coordinates (V, 2) and image, or else one colour, or else colours of vertices (V, 3)."""


def image_of(mesh: Any) -> Any:
    """Returns the texture of a trimesh mesh as a PIL image, or None."""
    material = getattr(mesh.visual, "material", None)
    return getattr(material, "image", None) or getattr(material, "baseColorTexture", None)


def one_mesh(meshes: list[Any], *, linear: bool) -> Any:
    """Joins trimesh meshes into one, their colours in sRGB; several textures become one image.

    ``linear``: the colours of their vertices are linear, as in glTF.
    """
    import trimesh

    for mesh in meshes:
        _make_plain(mesh, linear)
    return meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)


def look_of(mesh: Any) -> Look:
    """Returns what a mesh of ``one_mesh`` looks like.

    Raises:
        Exception: PIL's, where its image is broken.
    """
    visual = mesh.visual
    image, uv = image_of(mesh), getattr(visual, "uv", None)
    if uv is not None and image is not None and np.isfinite(uv).all():
        image = _eight_bits(image)
        if image.size[0] * image.size[1] > 4:  # else it is trimesh's way to say that there is none
            return np.asarray(uv, np.float64), image, GREY, None
        red, green, blue = image.getpixel((0, 0))
        return None, None, (red, green, blue), None
    if visual.kind in ("vertex", "face"):
        return None, None, GREY, np.asarray(visual.vertex_colors, np.uint8)[:, :3]
    main = getattr(getattr(visual, "material", None), "main_color", None)
    red, green, blue = (int(c) for c in (GREY if main is None else main[:3]))
    return None, None, (red, green, blue), None


def _make_plain(mesh: Any, linear: bool) -> None:
    """Leaves a mesh an image, a colour, or the colours of its vertices, all of them in sRGB."""
    import trimesh

    material: Any = getattr(mesh.visual, "material", None)
    if isinstance(material, trimesh.visual.material.PBRMaterial):
        uv, colors = mesh.visual.uv, mesh.visual.vertex_attributes.get("color")
        plain = _plain_material(material, uv)
        if plain.image is None and colors is not None:
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=_bytes(colors))
        else:
            mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=plain)
    elif getattr(material, "image", None) is not None:
        material.image = _eight_bits(material.image)
    if linear and mesh.visual.kind == "vertex":
        levels = srgb_of(np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0)
        mesh.visual.vertex_colors = (255 * levels).round().astype(np.uint8)


def _plain_material(material: Any, uv: Any) -> Any:
    """A glTF material's image times its colour, which is linear, or that colour alone.

    trimesh, where it joins several, multiplies in eight bits, which turns white to black.
    """
    import trimesh

    factor, image = material.baseColorFactor, material.baseColorTexture
    tint = np.ones(3) if factor is None else srgb_of(np.asarray(factor)[:3] / 255.0)
    if image is None or uv is None:
        color = [*(255 * tint).round().astype(int).tolist(), 255]
        return trimesh.visual.material.SimpleMaterial(diffuse=GREY if factor is None else color)
    image = _eight_bits(image)
    if (tint < 1).any():
        image = image.point([round(level * c) for c in tint for level in range(256)])
    return trimesh.visual.material.SimpleMaterial(image=image)


def _bytes(colors: Any) -> NDArray[np.uint8]:
    """Colours (V, 3 or 4) of any type of number as bytes (V, 3)."""
    levels = np.asarray(colors)[:, :3]
    top = np.iinfo(levels.dtype).max if levels.dtype.kind == "u" else 1.0
    return (255 * np.clip(levels / top, 0, 1)).round().astype(np.uint8)


def _eight_bits(image: Any) -> Any:
    """A PIL image as RGB; its own conversion would cut 16 bits off at 255."""
    if image.mode.startswith("I"):
        from PIL import Image

        levels = np.asarray(image, np.float64)
        image = Image.fromarray((levels / 257).round().clip(0, 255).astype(np.uint8))
    return image.convert("RGB")


def srgb_of(linear: Any) -> Any:
    """Linear levels of 0 to 1 as those of sRGB, by a power of 2.2."""
    return np.clip(linear, 0, 1) ** (1 / 2.2)


def linear_of(srgb: Any) -> Any:
    """Back again."""
    return np.clip(srgb, 0, 1) ** 2.2
