"""What ``ycb:048_hammer`` and ``gso:Schleich_Lion_Action_Figure`` mean: where, whose, how packed.

YCB keeps one .tgz per object and kind of scan; the 16k-triangle scans of Google's scanner are
taken. Google Scanned Objects lie on Gazebo Fuel as one .zip per object. Neither publishes
checksums. Both are CC BY 4.0: who uses them names their authors, so that is stored beside each.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tog_drake.errors import InputError
from tog_drake.urls import official_or_mirror

_CC_BY = "https://creativecommons.org/licenses/by/4.0/"

# Masses of the objects of the 29 [kg]: the YCB object list (Calli et al., "The YCB Object and
# Model Set", 2015, table of objects), by the URDF files of github.com/elpis-lab/ycb_dataset.
YCB_MASSES = {
    "006_mustard_bottle": 0.603,
    "019_pitcher_base": 0.178,
    "021_bleach_cleanser": 1.131,
    "025_mug": 0.118,
    "031_spoon": 0.030,
    "032_knife": 0.031,
    "033_spatula": 0.0515,
    "035_power_drill": 0.895,
    "037_scissors": 0.082,
    "043_phillips_screwdriver": 0.097,
    "044_flat_screwdriver": 0.0984,
    "048_hammer": 0.665,
}

# Objects that redistributions write otherwise than Fuel does, and the labels here with them.
_ON_FUEL = {"chefmate_8_frypan": "Chefmate_8_Frypan"}


@dataclass(frozen=True)
class Source:
    """A collection of scanned objects."""

    title: str
    licence: str
    attribution: str
    catalogue: str  # where a person finds the names
    base: str | None = None  # URL of the folder of archives; None: no server has them one by one
    variable: str = ""  # environment variable that names a mirror of it
    archive: str = ""  # name of an object's archive, for its {name}
    mesh: str = ""  # path in the archive
    textures: str | None = None  # folder in the archive, where they do not lie beside the mesh
    scale: float = 1.0  # metres per unit
    up: Literal["z", "y"] = "z"


SOURCES = {
    "ycb": Source(
        title="YCB Object and Model Set",
        # The same bucket as ycb-benchmarks.s3-website-us-east-1.amazonaws.com, by https.
        base="https://ycb-benchmarks.s3.amazonaws.com/data/google",
        variable="TOG_YCB_URL",
        archive="{name}_google_16k.tgz",
        mesh="{name}/google_16k/textured.obj",
        licence=f"CC BY 4.0, {_CC_BY}",
        attribution='"YCB Object and Model Set" (B. Calli, A. Singh, A. Walsman, S. Srinivasa, '
        "P. Abbeel, A. M. Dollar, 2015), www.ycbbenchmarks.com",
        catalogue="http://ycb-benchmarks.s3-website-us-east-1.amazonaws.com/",
    ),
    "gso": Source(
        title="Google Scanned Objects",
        base="https://fuel.gazebosim.org/1.0/GoogleResearch/models",
        variable="TOG_GSO_URL",
        archive="{name}.zip",
        mesh="meshes/model.obj",
        textures="materials/textures",
        licence=f"CC BY 4.0, {_CC_BY}",
        attribution='"Google Scanned Objects" (L. Downs, A. Francis, N. Koenig, B. Kinman, '
        "R. Hickman, K. Reymann, T. B. McHugh, V. Vanhoucke, ICRA 2022, arXiv:2204.11918), "
        "Copyright 2020 Google LLC",
        catalogue="https://app.gazebosim.org/GoogleResearch/fuel/collections/"
        "Scanned%20Objects%20by%20Google%20Research",
    ),
    "hope": Source(
        title="HOPE",
        licence="CC BY-NC-SA 4.0: not for commercial use",
        attribution='"NVIDIA HOPE" (S. Tyree et al., 2022, arXiv:2203.05701), '
        "Copyright 2021 NVIDIA Corporation",
        # The copy whose frames the part labels here are in; the whole: swtyree/hope-dataset.
        catalogue="github.com/Lifelong-Robot-Learning/LIBERO (assets/stable_hope_objects)",
        scale=0.01,
        up="y",
    ),
    "cy": Source(
        title="pybullet-URDF-models",
        licence="MIT",
        attribution="Copyright (c) 2021 Chen Yiting",
        catalogue="github.com/ChenEating716/pybullet-URDF-models",
    ),
}


@dataclass(frozen=True)
class Remote:
    """One object of a collection."""

    spec: str  # as given: ycb:048_hammer
    asset: str  # its name here: ycb_048_hammer
    name: str  # its name there
    source: Source
    mass: float | None  # [kg] where it is published

    @property
    def url(self) -> str:
        """Of its archive: on the official server, or on the mirror that the environment names.

        Raises:
            InputError: no server hands it out, or the mirror's URL is none.
        """
        return f"{_base(self)}/{self.source.archive.format(name=self.name)}"

    @property
    def archive(self) -> str:
        """Name of the file that its archive is kept in."""
        return self.asset + Path(self.source.archive).suffix

    @property
    def mesh(self) -> str:
        """Path of the mesh in the archive."""
        return self.source.mesh.format(name=self.name)

    def provenance(self, sha256: str) -> dict[str, str]:
        """What is recorded of its origin in the report of its import."""
        return {
            "spec": self.spec,
            "collection": self.source.title,
            "url": self.url,
            "sha256": sha256,  # of the archive
            "licence": self.source.licence,
            "attribution": self.source.attribution,
        }

    def licence_text(self, sha256: str) -> str:
        """The LICENSE.txt beside the object: what CC BY asks of who passes it on."""
        return (
            f"Object: {self.name}\n"
            f"Licence: {self.source.licence}\n"
            f"Attribution: {self.source.attribution}\n"
            f"Obtained from: {self.url}\n"
            f"SHA-256 of that archive: {sha256}\n"
            "Changes: converted for simulation by tog_drake: a smaller texture, a simplified "
            "surface for contact, mass and inertia.\n"
        )


def read_spec(spec: str) -> Remote:
    """Returns what ``COLLECTION:NAME`` means, or ``COLLECTION_NAME``, as it is called here.

    Raises:
        InputError: it is not of that form, or there is no such collection.
    """
    collection, *rest = re.split("[:_]", spec, maxsplit=1)
    if not rest or collection not in SOURCES:
        raise InputError(
            f"{spec!r:.120} is no object to fetch; valid: COLLECTION:NAME such as ycb:048_hammer "
            f"or gso:Schleich_Lion_Action_Figure; collections: {', '.join(SOURCES)}"
        )
    name = rest[0]
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,90}", name) or ".." in name:
        raise InputError(
            f"{name!r:.120} in {spec!r:.120} cannot be the name of an object: letters, digits, "
            "'_', '-' and '.' only"
        )
    here, there = name, name
    for ours, theirs in _ON_FUEL.items() if collection == "gso" else ():
        if name in (ours, theirs):
            here, there = ours, theirs
    mass = YCB_MASSES.get(name) if collection == "ycb" else None
    return Remote(spec, f"{collection}_{here}", there, SOURCES[collection], mass)


def _base(remote: Remote) -> str:
    source = remote.source
    if source.base is None:
        raise InputError(
            f"{remote.spec} is on no server that hands out single objects: {source.title} "
            f"({source.licence}) comes from {source.catalogue}. Once it is on this machine as "
            f"DIR/{remote.asset}/: tog assets add-dir DIR"
        )
    return official_or_mirror(source.base, source.variable)
