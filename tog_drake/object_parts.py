"""What is known of an object and its parts by those who judge: the content of a ``parts.yaml``."""

from dataclasses import dataclass
from pathlib import Path

from tog_drake.assets.model import MODEL
from tog_drake.errors import InputError
from tog_drake.files import read_yaml
from tog_drake.grammar import lemma
from tog_drake.lexicon import LEXICON
from tog_drake.regions import Region, read_regions
from tog_drake.resources import resource_dir
from tog_drake.task import read_task


@dataclass(frozen=True)
class ObjectParts:
    """What an object is and what its parts are for: the content of a ``parts.yaml``."""

    object: str
    words: tuple[str, ...]  # what a person may call it
    geometries: dict[str, str]  # collision geometry -> part; empty where there are regions
    part_words: dict[str, tuple[str, ...]]  # part -> what a person may call it
    tasks: dict[str, tuple[str, ...]]  # intent -> parts that may be held
    regions: tuple[Region, ...] = ()  # of a scanned object, whose surface they divide

    def allowed(self, task: str) -> frozenset[str] | None:
        """Returns the parts that the task allows to hold; None where its words do not say.

        A part named in the task overrides its intent; a part to be avoided is taken away, and
        where nothing else is asked for the others remain. None is allowed, an empty set, where
        the task says to leave things alone.
        """
        reading = read_task(task)
        if reading.forbidden:
            return frozenset()
        avoided = self._parts_called(reading.avoid)
        asked = frozenset(self.tasks.get(reading.intent or "", ()))
        if reading.parts:
            asked = self._parts_called(reading.parts)
        if asked - avoided:
            return asked - avoided
        return frozenset(self.part_words) - avoided if avoided else None

    def _parts_called(self, words: tuple[str, ...]) -> frozenset[str]:
        # A task's words for parts come in the spelling of the lexicon, labels as people say them.
        return frozenset(
            part
            for part, called in self.part_words.items()
            if {LEXICON.parts.get(lemma(word), word) for word in (part, *called)} & set(words)
        )


def unlabelled(name: str) -> ObjectParts:
    """What is known of an object of that name without labels: no task says where to hold it."""
    return ObjectParts(name, (name.replace("_", " "),), geometries={}, part_words={}, tasks={})


def load_parts(path: Path) -> ObjectParts:
    """Reads a ``parts.yaml`` (its form is described in ``models/README.md``).

    Raises:
        InputError: if the file is missing or not of that form.
    """
    try:
        content = read_yaml(path)
        parts = content["parts"]
        scanned = "regions" in content
        labels = ObjectParts(
            object=str(content["object"]),
            words=tuple(map(str, content["words"])),
            geometries={}
            if scanned
            else {str(g): part for part, p in parts.items() for g in p["geometries"]},
            part_words={part: tuple(map(str, p["words"])) for part, p in parts.items()},
            tasks={intent: tuple(allowed) for intent, allowed in content["tasks"].items()},
            regions=read_regions(content["regions"], list(parts)) if scanned else (),
        )
    except (InputError, LookupError, TypeError, AttributeError) as error:
        raise InputError(
            f"cannot read part labels from {path}: {error}; a labelled object has a parts.yaml "
            "beside its SDF with the keys object, words, parts and tasks, and regions where it is "
            "a scanned one"
        ) from error
    strange = {part for allowed in labels.tasks.values() for part in allowed} - {*parts}
    if strange:
        raise InputError(f"{path}: tasks name {strange}; the parts are {', '.join(parts)}")
    return labels


def labels_file(model: Path) -> Path | None:
    """Returns the part labels of a model (its SDF), if it has any.

    They are the ``parts.yaml`` beside it; else, for an imported object, those that come with the
    package (``models/labels``).
    """
    ours = resource_dir("models") / "labels" / f"{model.parent.name}.yaml"
    files = [model.parent / "parts.yaml", *([ours] if model.name == MODEL else [])]
    return next((path for path in files if path.is_file()), None)
