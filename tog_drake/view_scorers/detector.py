"""Views scored by an open-vocabulary detector that runs here: OWLv2, through transformers.

OWLv2 (Minderer, Gritsenko, Houlsby: Scaling Open-Vocabulary Object Detection, NeurIPS 2023) is
asked for "a photo of a TARGET", as its authors' model card does. transformers and the released
weights are both under the Apache licence 2.0. Neither comes with this package, and nothing is
downloaded in a run: what is not in the cache of Hugging Face is an error that says how to get it.
Only safetensors are read, and no code that lies beside weights is ever run.

A network of the default's size needs 1.3 GB and, on a processor, some 20 s of it for every view.
"""

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud

from tog_drake.errors import InputError
from tog_drake.values import CameraView, Candidates
from tog_drake.view_scorers.detections import Detection, check_target, score_detections
from tog_drake.view_selection import Scores
from tog_drake.visible_text import quoted

MODEL = "google/owlv2-base-patch16-ensemble"
REVISION = "7c77fc1316a353da3109f81d80ae118dd58fd55b"  # the one that has its weights as safetensors
FAMILIES = ("owlvit", "owlv2")
"""What OWL-ViT and OWLv2 call themselves; other detectors of transformers read other forms of
words and have other confidences."""
_NAME = re.compile(r"(?!.*(--|\.\.))\w[\w.-]{0,60}\w/\w[\w.-]{0,60}\w", re.ASCII)
_FILES = ("config.json", "model.safetensors")
_READ = {".json", ".txt", ".safetensors"}  # suffixes of all that transformers reads of a detector

_log = logging.getLogger(__name__)


@dataclass
class Detector:
    """Finds the target in each view: `!Detector {}`."""

    model: str = MODEL  # an OWL-ViT or OWLv2 on Hugging Face, or a folder with its files
    revision: str | None = None  # commit or branch; None: the one that was tested, or main
    device: str = "cpu"  # as torch calls it: cpu, cuda, cuda:1, mps
    threshold: float = 0.1  # confidence below which nothing was found, from 0 to 1


class DetectorScorer:
    """Scores views by what a detector finds in them (a ``ViewScorer``).

    The network is loaded when the first view is scored, and kept for other scorers of the same
    files.

    Raises:
        InputError: a field of the config is out of its bounds, transformers or torch is not
            installed, or there are no weights; says which command gets them.
    """

    def __init__(self, config: Detector):
        if not 0.0 <= config.threshold < 1.0:
            raise InputError(
                f"!Detector: threshold: {config.threshold:g}; valid: from 0 to below 1"
            )
        self._config = config
        self._folder = find_detector(config)

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns the greatest confidence in each view, 0 where the target was not found.

        Raises:
            NoView: the target has no words.
            InputError: the files are no weights of a detector, the device cannot be used, or the
                target has too many words.
        """
        check_target(target)
        network = load(self._folder, self._config.device)
        threshold = self._config.threshold
        # One after the other, or five views would take five times the memory of one.
        found = [network.detect(seen.view.rgb, target, threshold) for seen in views]
        return score_detections(views, found, target, self._config.model)


def find_detector(config: Detector) -> Path:
    """Returns the folder with the files of the detector that a config names, without loading it.

    Raises:
        InputError: transformers or torch is not installed, or there are no weights; says which
            command gets them.
    """
    require_transformers()
    return find_weights(config.model, config.revision)


def detector_files(config: Detector) -> list[Path]:
    """Returns all files that decide what a detector finds. Raises as ``find_detector``."""
    return sorted(file for file in find_detector(config).iterdir() if file.suffix in _READ)


def require_transformers() -> None:
    """Raises InputError where transformers or torch is not installed; says how to install them."""
    for module in ("transformers", "torch"):
        if find_spec(module) is None:
            raise InputError(
                f"the view scorer detector needs {module}, which is not installed; install it "
                "with: pip install 'tog_drake[views]'"
            )


def find_weights(model: str, revision: str | None) -> Path:
    """Returns the folder that holds a detector's files.

    Args:
        model: a folder, or a name on Hugging Face whose files are looked for in its cache.
        revision: of that name; None: the one that was tested, of others main.

    Raises:
        InputError: there is none; says how to get it.
    """
    if model and Path(model).is_dir():
        missing = [name for name in _FILES if not (Path(model) / name).is_file()]
        if missing:
            raise InputError(
                f"{model} holds no detector: it has no {' and no '.join(missing)}; valid: a folder "
                "with the files of an OWLv2 of transformers, its weights as model.safetensors"
            )
        return Path(model)
    if not _NAME.fullmatch(model):
        raise InputError(
            f"there is no folder {quoted(model)}, and it is no name on Hugging Face; valid: one "
            f"such as {MODEL}"
        )
    from huggingface_hub import constants, try_to_load_from_cache

    revision = revision or (REVISION if model == MODEL else "main")
    cached = [try_to_load_from_cache(model, name, revision=revision) for name in _FILES]
    if not all(isinstance(file, str) for file in cached):
        raise InputError(
            f"the weights of {model} (revision {revision}) are not on this machine, in the cache "
            f"{constants.HF_HUB_CACHE}; get them with `{download_command(model, revision)}` "
            "(Apache-2.0 and 0.6 GB by default), or name a folder that has them: "
            "!Detector {model: FOLDER}"
        )
    return Path(str(cached[0])).parent


def download_command(model: str = MODEL, revision: str = REVISION) -> str:
    """Returns the command that puts a detector's files into the cache of Hugging Face."""
    return f"hf download {model} --revision {revision} --exclude '*.bin'"


@dataclass(frozen=True)
class Network:
    """A detector and what prepares its inputs, by the classes of transformers."""

    processor: Any
    model: Any
    most_tokens: int  # of what is looked for

    def detect(self, rgb: NDArray[np.uint8], target: str, threshold: float) -> list[Detection]:
        """Returns the boxes in an image (H, W, 3) of which it is surer than ``threshold``.

        Raises:
            InputError: the target has too many words.
        """
        import torch

        words = f"a photo of a {target}"
        tokens = len(self.processor.tokenizer(words)["input_ids"])
        if tokens > self.most_tokens:
            raise InputError(
                f"the target {quoted(target)} is {tokens} tokens long with what is asked around "
                f"it; the detector reads {self.most_tokens}: name it in fewer words (--target)"
            )
        inputs = self.processor(text=[[words]], images=rgb, return_tensors="pt")
        with torch.inference_mode():
            outputs = self.model(**inputs.to(self.model.device))
        (found,) = self.processor.post_process_grounded_object_detection(
            outputs, threshold=threshold, target_sizes=[rgb.shape[:2]]
        )
        boxes, scores = found["boxes"].tolist(), found["scores"].tolist()
        return [
            Detection(target, (box[0], box[1], box[2], box[3]), score)
            for box, score in zip(boxes, scores, strict=True)
        ]


@lru_cache(maxsize=1)  # every episode of a benchmark makes a pipeline, and loading takes seconds
def load(folder: Path, device: str) -> Network:
    """Loads a detector onto a device.

    Raises:
        InputError: the files are no whole OWL-ViT or OWLv2, or the device cannot be used.
    """
    transformers = import_module("transformers")
    local: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    with _quiet(transformers):
        try:
            config = transformers.AutoConfig.from_pretrained(folder, **local)
            if config.model_type not in FAMILIES:
                raise ValueError(f"it is a {config.model_type}; valid: {' or '.join(FAMILIES)}")
            # Pillow, whether or not torchvision is there: they resize to other pixels.
            processor = transformers.AutoProcessor.from_pretrained(folder, backend="pil", **local)
            model, loaded = transformers.AutoModelForZeroShotObjectDetection.from_pretrained(
                folder, config=config, use_safetensors=True, output_loading_info=True, **local
            )
            if absent := loaded["missing_keys"] or loaded["mismatched_keys"]:
                raise ValueError(f"{len(absent)} of its parameters are not among the weights")
        except Exception as error:  # of transformers and all that it stands on, safetensors too
            raise InputError(
                f"{folder} holds no detector that can be loaded ({type(error).__name__}: "
                f"{quoted(str(error))}); valid: the files of an OWL-ViT or OWLv2 of transformers, "
                f"such as those of {download_command()}"
            ) from error
    try:
        model = model.to(device).eval()
    except (RuntimeError, AssertionError, ValueError) as error:
        raise InputError(
            f"!Detector: device {device!r} cannot be used ({quoted(str(error))}); valid: cpu, or "
            "an accelerator that this torch knows, such as cuda"
        ) from error
    _log.info("%s loaded onto %s", folder, device)
    return Network(processor, model, config.text_config.max_position_embeddings)


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Keeps what transformers says while it loads off the terminal."""
    said = transformers.utils.logging
    verbosity, bar = said.get_verbosity(), said.is_progress_bar_enabled()
    said.set_verbosity_error()
    said.disable_progress_bar()
    try:
        yield
    finally:
        said.set_verbosity(verbosity)
        if bar:
            said.enable_progress_bar()
