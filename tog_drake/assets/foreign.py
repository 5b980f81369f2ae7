"""Opens mesh files that strangers wrote: what they refer to, and how large they claim to be.

A mesh names further files: materials, textures, buffers. They are looked for in the mesh's own
folder and nowhere else, whatever path stands there; nothing is fetched from a network.
"""

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from tog_drake.assets.look import image_of
from tog_drake.errors import InputError

MAX_FILE_BYTES = 500_000_000
MAX_FACES = 5_000_000
MAX_TEXTURE_PIXELS = 80_000_000  # of all textures together; one of 8192 × 8192 has 67 million
TEXTURES = ("PNG", "JPEG", "BMP", "TIFF", "TGA", "WEBP")  # formats, as PIL calls them


class Beside:
    """Finds what a mesh refers to, for trimesh, which calls this a resolver."""

    def __init__(self, path: Path):
        self.file_name = path.name
        self.missing: list[str] = []  # what was asked for and is not there
        self._folder = path.resolve().parent

    def get(self, name: str) -> bytes:
        r"""Returns the content of a file in the mesh's folder.

        A path that leads elsewhere, such as ``C:\scans\texture.png``, ``../texture.png`` or a
        network address, stands for the file of that name here, or in such a folder ``scans`` here;
        small letters may stand for capitals.

        Raises:
            FileNotFoundError: there is none, or it is too large.
        """
        plain = unquote(name.strip()).replace("\\", "/")
        parts = plain.rsplit("/", 3)
        tails = ["/".join(parts[-kept:]) for kept in (3, 2, 1)]
        # The options of an MTL stand before the name: -s 1 1 1 texture.png
        for candidate in (name.strip(), plain, *tails, parts[-1].rsplit(" ", 1)[-1]):
            found = self._inside(candidate)
            if found is not None:
                return found.read_bytes()
        self.missing.append(name)
        raise FileNotFoundError(f"{name!r:.200} is not in the folder of {self.file_name}")

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def _inside(self, name: str) -> Path | None:
        try:
            path = self._folder / name
            if not path.exists() and path.parent.is_dir():  # written where letters' case is nothing
                alike = (p for p in path.parent.iterdir() if p.name.lower() == path.name.lower())
                path = next(alike, path)
            path = path.resolve()
            inside = path.is_relative_to(self._folder) and path.is_file()
            return path if inside and path.stat().st_size <= MAX_FILE_BYTES else None
        except (OSError, ValueError):  # a name that no file system knows
            return None


def check_size(path: Path) -> None:
    """Refuses a file that is not there, or too large.

    Raises:
        InputError: so it is.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}; valid: a mesh, such as mug.obj")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path} has more than {MAX_FILE_BYTES} bytes; decimate it first")


def load_meshes(path: Path) -> tuple[list[Any], list[str]]:
    """Returns the trimesh meshes of a file, where its scene puts them, and what is missing.

    Raises:
        InputError: the file claims to be larger than is read here.
        Exception: whatever the readers of half a dozen formats raise.
    """
    import trimesh

    check_size(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind in ("gltf", "glb"):
        _check_gltf(path.read_bytes())
    beside: Any = Beside(path)
    with path.open("rb") as file:
        scene = trimesh.load(file, file_type=kind, resolver=beside, force="scene", process=False)
    used = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    faces = sum(len(getattr(scene.geometry[name], "faces", ())) for name in used)
    _check_faces(faces)
    _check_textures(scene.geometry.values())
    meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    return meshes, beside.missing


def _check_faces(count: int) -> None:
    if count == 0:
        raise InputError("it holds no triangles; a cloud of points must be meshed first")
    if count > MAX_FACES:
        raise InputError(f"it holds {count} triangles; valid: up to {MAX_FACES}; decimate it first")


def _check_textures(geometries: Any) -> None:
    """Before any is decoded: a small file may hold a huge image."""
    images = {id(i): i for g in geometries if (i := image_of(g)) is not None}
    pixels = sum(image.size[0] * image.size[1] for image in images.values())
    if pixels > MAX_TEXTURE_PIXELS:
        raise InputError(f"its textures have {pixels} pixels; valid: up to {MAX_TEXTURE_PIXELS}")
    for image in images.values():
        if image.format not in (*TEXTURES, None):
            raise InputError(f"its texture is {image.format}; valid: {', '.join(TEXTURES)}")


def _check_gltf(data: bytes) -> None:
    """Adds up what the header claims: a few bytes may ask for any memory, or for any time."""
    if data[:4] == b"glTF":
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        tree = json.loads(data)
        counts = [int(accessor["count"]) for accessor in tree.get("accessors", ())]
        nodes = tree.get("nodes", ())
        children = [child for node in nodes for child in node.get("children", ())]
        used = [
            counts[primitive.get("indices", primitive["attributes"]["POSITION"])]
            for node in nodes
            if "mesh" in node
            for primitive in tree["meshes"][node["mesh"]]["primitives"]
        ]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"its glTF header cannot be read: {error!r:.200}") from error
    if len(set(children)) < len(children):
        raise InputError("its glTF nodes are no tree: one is the child of two")
    if min(counts, default=0) < 0 or sum(counts) > 20 * MAX_FACES:
        raise InputError(f"its glTF header claims {sum(counts)} numbers, which is too many")
    _check_faces(sum(used) // 3)
