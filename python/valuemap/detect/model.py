"""An ONNX model: what it takes, what its outputs mean and what its classes are called, found out once at the door."""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from valuemap.config import DetectConfig, ModelKind
from valuemap.detect.letterbox import Fit, Pixels, Size, fit_around, fit_into
from valuemap.detect.signature import (
    KIND_HINT,
    SIZES_INPUT,
    Preparation,
    class_count,
    coco_names,
    names_in,
    plain_name,
    preparation_of,
    recognise,
)
from valuemap.errors import InputError, SettingError

Array = NDArray[Any]

_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
_PROVIDER_OPTIONS: Mapping[str, Mapping[str, str]] = {
    "cpu": {},
    # The best algorithm for a size is chosen by rule: trying all of them takes long and may choose another next time.
    "cuda": {"cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"},
}
_CUDA_FAILURE = re.compile(r"CUDA failure \d+: ([^;\n]+)")
_DTYPES: Mapping[str, type[np.number[Any]]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}


@dataclass(frozen=True, eq=False)
class Model:
    """A model ready to run.

    `class_count` is None where the outputs do not tell; `fixed` is the width and height that it insists on, None if it
    takes any multiple of `stride`; `made_for` is the size in the file, left open where the user asks for another one;
    `fixed_batch` as `fixed`. TensorFlow's channels come last; `sizes_input` is the name
    of a second input, for width and height of the canvas. `threshold` and `minimum_component_px` are of
    segmentations; boxes with a lower score than `min_score` are dropped where the user does not say otherwise;
    pictures with a smaller `coarse_share` than `min_coarse_share` are not looked at; `is_softmax` is of
    DETRs, whose last class is then "nothing".
    """

    path: Path
    sha256: str
    session: Any
    kind: str
    class_names: tuple[str, ...]
    class_count: int | None
    fixed: Size | None
    made_for: Size | None
    fixed_batch: int | None
    has_batch: bool
    is_channels_last: bool
    sizes_input: str | None
    stride: int
    preparation: Preparation
    threshold: float
    minimum_component_px: int
    min_coarse_share: float
    min_score: float
    is_softmax: bool

    def fit(self, picture: Size, size: Size | None) -> Fit:
        """Return how a picture of a size is brought to what the network takes; `size` is what the user asked for."""
        canvas = size or self.fixed
        if canvas is None:
            return fit_around(picture, self.stride)
        return fit_into(picture, canvas, self.preparation.fitting)

    def run(self, canvases: Sequence[Pixels]) -> list[Array]:
        """Run canvases (height, width, 3), RGB, of one size, and return the outputs.

        Raises
        ------
        InputError
            The network cannot be run on this size or number of pictures.
        """
        entry = self.session.get_inputs()[0]
        batch = np.empty((self.fixed_batch or len(canvases), 3, *canvases[0].shape[:2]), np.float32)
        batch[len(canvases) :] = 0.0
        for row, canvas in enumerate(canvases):
            self._prepare(canvas, batch[row])
        tensor = batch.astype(_DTYPES[entry.type], copy=False)
        if self.is_channels_last:
            tensor = np.ascontiguousarray(np.moveaxis(tensor, 1, 3))
        width, height = canvases[0].shape[1::-1]
        feed = {entry.name: tensor if self.has_batch else tensor[0]}
        if self.sizes_input is not None:
            feed[self.sizes_input] = np.tile(np.array([width, height], np.int64), (len(batch), 1))
        try:
            outputs: list[Array] = self.session.run(None, feed)
        except Exception as error:  # ONNX Runtime's errors have no base of their own.
            if self.made_for is not None and (width, height) != self.made_for:
                own = f"{self.made_for[0]} x {self.made_for[1]} px"
                raise InputError(
                    f"{self.path}: cannot be run on {width} x {height} px: it was made for {own}",
                    hint="leave --size away; some such models also take other multiples of 32 px",
                ) from error
            raise InputError(
                f"{self.path}: cannot be run on a batch of {len(batch)}, {width} x {height} px: {_first_line(error)}",
                hint="choose what the network takes with --size and --batch; many take multiples of 32 px only",
            ) from error
        return outputs

    def _prepare(self, canvas: Pixels, out: NDArray[np.float32]) -> None:
        """Write (pixel / 255 - mean) / std of a canvas into `out` (3, height, width)."""
        how = self.preparation
        channels = (0, 1, 2) if how.color == "RGB" else (2, 1, 0)
        for i, channel in enumerate(channels):
            gain = np.float32(1.0 / (255.0 * how.std[i]))
            np.multiply(canvas[:, :, channel], gain, out=out[i], casting="unsafe")
            if how.mean[i]:
                out[i] -= np.float32(how.mean[i] / how.std[i])


def load_model(path: Path, config: DetectConfig, *, threads: int = 0) -> Model:
    """Open an ONNX file and find out what it is; it is run on so many threads, 0 for one a core.

    Raises
    ------
    InputError
        No such file, no ONNX file, or a model of a shape that cannot be used.
    SettingError
        The provider is not installed.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give an ONNX file, or bundled")
    content = path.read_bytes()
    session = _open(path, content, config.provider, threads)
    inputs, outputs = session.get_inputs(), session.get_outputs()
    metadata = session.get_modelmeta().custom_metadata_map
    extra = [entry.name for entry in inputs[1:] if plain_name(entry) == SIZES_INPUT and entry.type == "tensor(int64)"]
    if len(inputs) != 1 + len(extra) or inputs[0].type not in _DTYPES or len(inputs[0].shape) not in (3, 4):
        found = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        raise InputError(
            f"{path}: expected one input of pictures, float [batch, 3, height, width], found {found}",
            hint="export the network alone, without what comes before or after it",
        )
    has_batch = len(inputs[0].shape) == 4
    is_channels_last = has_batch and inputs[0].type == "tensor(uint8)" and inputs[0].shape[3] == 3
    batch, channels, height, width = inputs[0].shape if has_batch else (1, *inputs[0].shape)
    if is_channels_last:
        batch, height, width, channels = inputs[0].shape
    if isinstance(channels, int) and channels != 3:
        raise InputError(
            f"{path}: expected an input of 3 channels [batch, 3, height, width], found {inputs[0].shape}",
            hint="export it for colour pictures, channels first",
        )
    fixed = made_for = (width, height) if isinstance(width, int) and isinstance(height, int) else None
    names = names_in(path, metadata)
    kind = config.kind or metadata.get("valuemap.kind")
    if kind is None:
        kind = recognise(path, outputs, metadata, names if "names" in metadata else (), fixed)
    if kind not in get_args(ModelKind):
        raise InputError(f"{path}: kind {kind!r} is not known", hint=KIND_HINT)
    size = config.size_px
    if fixed is not None and (config.size == "picture" or (size is not None and size != fixed)):
        session = _open(path, _with_free_size(content, is_channels_last), config.provider, threads)
        fixed = None
    if kind == "boxes" and all(len(output.shape) != 3 for output in outputs):
        batch = 1  # Its boxes have no batch: they would be those of the first picture.
    count = class_count(kind, outputs, names if "names" in metadata else ())
    names = names or coco_names(count)
    return Model(
        path=path,
        sha256=hashlib.sha256(content).hexdigest(),
        session=session,
        kind=kind,
        class_names=names,
        class_count=count,
        fixed=fixed,
        made_for=made_for,
        fixed_batch=batch if isinstance(batch, int) else None,
        has_batch=has_batch,
        is_channels_last=is_channels_last,
        sizes_input=extra[0] if extra else None,
        stride=int(_number(path, metadata, "stride", 32, least=1)),
        preparation=preparation_of(path, kind, inputs, outputs, metadata),
        threshold=_number(path, metadata, "valuemap.threshold", 0.5),
        minimum_component_px=int(_number(path, metadata, "valuemap.minimum_component_px", 1)),
        min_coarse_share=_number(path, metadata, "valuemap.min_coarse_share", 0.0),
        min_score=_number(
            path, metadata, "valuemap.min_score", 0.0 if kind == "segmentation" else config.default_min_score
        ),
        # A last class for "nothing" is one more than there are names, or than COCO's numbers.
        is_softmax=count is not None and count == (len(names) or 91) + 1,
    )


def _open(path: Path, content: bytes, provider: str, threads: int) -> Any:
    wanted = _PROVIDERS[provider]
    if wanted not in onnxruntime.get_available_providers():
        raise _no_provider(provider)
    missing = _load_cuda() if provider == "cuda" else ""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # Errors come as exceptions; warnings are about the export.
    # Threads that wait for work would otherwise spin, on the cores that decode the next pictures.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        # With its fallback it would print that a provider fails, and go on with the CPU.
        session = onnxruntime.InferenceSession(
            content, options, providers=[(wanted, _PROVIDER_OPTIONS[provider])], enable_fallback=0
        )
    except Exception as error:  # ONNX Runtime's errors have no base of their own.
        if provider == "cuda" and (reason := _CUDA_FAILURE.search(str(error))):
            raise _no_provider(provider, reason[1].strip()) from error
        other = _other_file(content)
        if other is not None:
            raise InputError(
                f"{path}: keeps its weights in another file, {other!r}",
                hint="put them into one: onnx.save(onnx.load(IN), OUT), or external_data=False in torch.onnx.export",
            ) from error
        hint = "is it whole? Export it again"
        if "is not a registered function/op" in str(error):
            hint = "it has operators of another program, such as TensorRT: export it for ONNX Runtime, without them"
        elif path.suffix.lower() != ".onnx":
            hint = "export the model as ONNX; of other kinds none is read"
        raise InputError(f"{path}: cannot be read as an ONNX model: {_first_line(error)}", hint=hint) from error
    if wanted not in session.get_providers():  # Without CUDA's libraries it would go on with the CPU.
        raise _no_provider(provider, missing)
    return session


def _load_cuda() -> str:
    """Load CUDA's libraries: those that pip installs are not where libraries are looked for; return what is missing."""
    onnxruntime.set_default_logger_severity(4)  # What it cannot load is said in the error.
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        onnxruntime.preload_dlls()
    told = (line for line in printed.getvalue().splitlines() if line.startswith("Failed to load"))
    return next(told, "").partition(": ")[2]


def _other_file(content: bytes) -> str | None:
    """Return the name of the file that a model keeps its weights in, if it is not this one."""
    import onnx  # Only models that cannot be opened need it.

    try:
        weights = onnx.load_from_string(content).graph.initializer
    except Exception:  # Then it is no model at all, which is said elsewhere.
        return None
    entries = (entry for each in weights if each.data_location == each.EXTERNAL for entry in each.external_data)
    return next((str(entry.value) for entry in entries if entry.key == "location"), None)


def _no_provider(provider: str, reason: str = "") -> SettingError:
    return SettingError(
        f"--provider {provider}: this ONNX Runtime cannot do that here" + (f": {reason}" if reason else ""),
        hint="install onnxruntime-gpu in place of onnxruntime, with CUDA and a driver, or use --provider cpu",
    )


def _with_free_size(content: bytes, is_channels_last: bool) -> bytes:
    """Return the model with height and width left open, as a fully convolutional one can be run."""
    import onnx  # Only models of a fixed size need it.

    model = onnx.load_from_string(content)
    del model.graph.value_info[:]  # They hold the sizes of everything in between.
    axes = model.graph.input[0].type.tensor_type.shape.dim
    for axis, name in zip(axes[1:3] if is_channels_last else axes[-2:], ("height", "width"), strict=True):
        axis.dim_param = name
    for output in model.graph.output:
        output.type.tensor_type.ClearField("shape")
    rewritten: bytes = model.SerializeToString()
    return rewritten


def _number(path: Path, metadata: Mapping[str, str], name: str, default: float, *, least: float = 0.0) -> float:
    try:
        value = float(metadata.get(name, default))
    except ValueError:
        value = math.nan
    if not least <= value < math.inf:
        raise InputError(
            f"{path}: metadata {name}: expected a number of at least {least:g}, found {metadata[name]!r}",
            hint="export it again",
        )
    return value


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
