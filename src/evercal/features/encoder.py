"""The frozen local encoder: one feature vector for every cell of 8x8 pixels.

OpenCV runs the networks, so no other runtime is needed. The shipped ones are trained on procedural
images alone (`python -m training`). A network of the caller's own is an ONNX file or a Python
function on arrays.
"""

import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.features.views import working_grey
from evercal.features.vlad import Vlad, fit_centroids, unit
from evercal.storage.atomic import naming_file, write_bytes
from evercal.storage.tensors import load_tensors, save_tensors
from evercal.typing import Array, Float32Array, Image, JsonObject, Strings

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of the shipped networks and centroids."""
ENCODER_FILE = WEIGHTS / "encoder-2.onnx"
"""The shipped encoder of new maps."""
Features = Callable[[Float32Array], Array]
"""A network: (h, w) grey values with mean 0 and deviation 1 -> (rows, columns, width) features.

Cell (i, j) is centred on pixel (stride (j + 0.5) - 0.5, same for i)."""
_TEACHER = "840d7d903caaa691"
"""Digest of the weights of `encoder-1.onnx` as maps written by earlier versions store them."""
_PROBE = 192, 256
"""Height and width of the image that stride and width are read from."""
_FINGERPRINT_TOLERANCE = 0.02
"""Maximum difference of features that a map's function may have on another machine."""
_STRIDES = (1, 2, 4, 8, 16)
"""Allowed sides of a cell, pixels."""


class Encoder:
    """A network with its VLAD centroids, which are part of a map.

    `stride` is the side of a cell in pixels, `width` the number of channels.
    """

    def __init__(self, function: Features, name: str, data: bytes = b""):
        self.name = name
        self.function = function
        self.data = data
        probe = _standardised(_probe())
        features = np.asarray(function(probe))
        rows = [_PROBE[0] // stride for stride in _STRIDES]
        if features.ndim != 3 or len(features) not in rows:
            raise InputError(
                f"encoder {name}: made {features.shape} from an image of {_PROBE} pixels; it must"
                " make (rows, columns, channels) with a stride of 1, 2, 4, 8 or 16 pixels"
            )
        self.stride = _PROBE[0] // len(features)
        self.width = features.shape[2]
        mean = unit(features).mean((0, 1))
        self.fingerprint = mean[:8].round(4).tolist()
        self._centroids: Float32Array | None = None
        self._vlad: Vlad | None = None

    def __call__(self, grey: Image) -> Float32Array:
        """(h, w) -> (h // stride, w // stride, width) unit vectors."""
        height, width = grey.shape
        height -= height % self.stride
        width -= width % self.stride
        standardised = _standardised(grey[:height, :width])
        return unit(self.function(standardised))

    def encode(self, image: Image, short_side: int) -> Float32Array:
        """(rows, columns, width) features of an image (h, w) or (h, w, 3) at working size."""
        return self(working_grey(image, short_side))

    @property
    def centroids(self) -> Float32Array | None:
        """(k, width) VLAD centroids; None before they are fitted."""
        return self._centroids

    @centroids.setter
    def centroids(self, value: Float32Array | None) -> None:
        self._centroids = value
        self._vlad = None

    def vlad(self, features: Sequence[Float32Array] = ()) -> Vlad:
        """The VLAD of the encoder; missing centroids are fitted to features (cells, width)."""
        if self._centroids is None:
            if not features:
                raise InputError(
                    "the encoder has no VLAD centroids; learn a recording first"
                )
            self.centroids = fit_centroids(features)
        if not self._vlad:
            assert self._centroids is not None, "just fitted"
            self._vlad = Vlad(self._centroids)
        return self._vlad

    def __getstate__(self) -> JsonObject:
        return self.__dict__ | {"_vlad": None}

    def write(self, root: Path) -> Strings:
        """Write the network, and centroids that are not shipped; return the names of the files."""
        shipped = False
        if self.data:
            stem = self.name.removesuffix(".onnx")
            network = f"{stem}.onnx"
            vlad = f"{stem.replace('encoder', 'vlad', 1)}.safetensors"
            write_bytes(root / network, self.data)
            shipped = (WEIGHTS / self.name).exists()
        else:
            network = "encoder.json"
            vlad = "vlad.safetensors"
            record = {
                "function": self.name,
                "fingerprint": self.fingerprint,
            }
            text = json.dumps(record, indent=1)
            write_bytes(root / network, text.encode())
        if self._centroids is None or shipped:
            return (network,)
        save_tensors(root / vlad, {"centroids": self._centroids})
        return network, vlad

    def require_same(self, record: Any, path: Path) -> None:
        """Compare with a record of `write`; another function is an `InputError`."""
        stored = np.asarray(record["fingerprint"], float)
        current = np.asarray(self.fingerprint)
        same = stored.shape == current.shape
        if not same or np.abs(stored - current).max() > _FINGERPRINT_TOLERANCE:
            raise InputError(
                f"{path}: encoder {self.name} makes other features than"
                f" {record['function']!r}, which the map was made with"
            )


class _OnnxNetwork:
    """An ONNX network in OpenCV: grey (1, 1, h, w) -> (1, width, rows, columns).

    A network cannot calculate in two threads, so every thread takes one of its own.
    """

    def __init__(self, data: bytes, name: str):
        self.data = data
        self.name = name
        self._idle: SimpleQueue[Any] = SimpleQueue()
        self._idle.put(self._read())

    def __call__(self, grey: Float32Array) -> Float32Array:
        try:
            network = self._idle.get_nowait()
        except Empty:
            network = self._read()
        try:
            network.setInput(grey[None, None])
            (channels,) = network.forward()
            return np.ascontiguousarray(channels.transpose(1, 2, 0))
        except (cv2.error, ValueError) as error:
            words = str(error).split()
            reason = " ".join(words)[:200]
            raise InputError(
                f"encoder {self.name}: does not run on an image ({reason})"
            ) from None
        finally:
            self._idle.put(network)

    def __reduce__(self) -> tuple[Any, ...]:
        return _OnnxNetwork, (self.data, self.name)

    def _read(self) -> Any:
        # OpenCV's classic engine takes half the time, and is only used for a file.
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "encoder.onnx"
            with naming_file(file):
                file.write_bytes(self.data)
            level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            try:
                for source, engine in (
                    (
                        str(file),
                        cv2.dnn.ENGINE_CLASSIC,
                    ),
                    (
                        str(file),
                        cv2.dnn.ENGINE_AUTO,
                    ),
                    # On Windows OpenCV opens no file whose path is not ASCII.
                    (
                        np.frombuffer(self.data, np.uint8),
                        cv2.dnn.ENGINE_AUTO,
                    ),
                ):
                    try:
                        return cv2.dnn.readNetFromONNX(source, engine=engine)
                    except cv2.error as error:
                        words = str(error).split()
                        reason = " ".join(words)[:200]
            finally:
                cv2.utils.logging.setLogLevel(level)
        raise InputError(
            f"encoder {self.name}: OpenCV cannot read this ONNX file ({reason})"
        )


def load_encoder(
    source: Path | Features | Encoder | None = None, stored: Path | None = None
) -> Encoder:
    """An encoder: the shipped one, an ONNX file, or a function on arrays (see `Features`).

    `stored` is the file of a map's encoder; a function must be the one that it names.
    """
    if isinstance(source, Encoder):
        encoder = source
    elif isinstance(source, Path) or source is None:
        encoder = _of_file(stored or source or ENCODER_FILE)
    elif callable(source):
        name = getattr(source, "__name__", type(source).__name__)
        encoder = Encoder(source, name)
    else:
        raise InputError(
            f"encoder {source!r}: give an ONNX file or a function on arrays"
        )
    if stored and stored.suffix == ".json":
        record = json.loads(stored.read_bytes())
        encoder.require_same(record, stored)
    return encoder


def _of_file(path: Path) -> Encoder:
    if path.suffix == ".json":
        record = json.loads(path.read_bytes())
        name = record["function"]
        raise InputError(
            f"{path}: the map was made with the function {name!r}; give it as encoder"
        )
    if not path.is_file():
        raise InputError(f"encoder {path}: no such file")
    name, data = read_network(path)
    # Maps written by earlier versions hold weights of PyTorch.
    if name is None and path.suffix == ".safetensors":
        raise InputError(
            f"encoder {path}: weights of a PyTorch module; export the module to an ONNX file or"
            " wrap it in a function, and give that as encoder"
        )
    network = _OnnxNetwork(data, str(path))
    if name is None:
        digest = hashlib.sha256(data).hexdigest()[:12]
        return Encoder(network, f"encoder-{digest}.onnx", data)
    encoder = Encoder(network, name, data)
    stem = Path(name).stem
    stem = stem.replace("encoder", "vlad")
    tensors = load_tensors(WEIGHTS / f"{stem}.safetensors")
    centroids = tensors["centroids"]
    encoder.centroids = centroids.astype(np.float32)
    return encoder


def read_network(path: Path) -> tuple[str | None, bytes]:
    """Name of the shipped network in the file of a map, None for another one, and its data."""
    if path.suffix == ".safetensors":
        if _digest(load_tensors(path)) != _TEACHER:
            return None, b""
        path = WEIGHTS / "encoder-1.onnx"
    data = path.read_bytes()
    for shipped in sorted(WEIGHTS.glob("*.onnx")):
        if shipped.read_bytes() == data:
            return shipped.name, data
    return None, data


def _digest(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name].tobytes()
        digest.update(name.encode() + values)
    return digest.hexdigest()[:16]


def _probe() -> Image:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, _PROBE).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return np.asarray(blurred, np.uint8)


def _standardised(grey: Image) -> Float32Array:
    """Mean 0 and deviation 1, which removes exposure and contrast."""
    means, deviations = cv2.meanStdDev(grey)
    mean = float(means[0, 0])
    deviation = float(deviations[0, 0])
    unbiased = grey.size / max(grey.size - 1, 1)
    deviation *= unbiased**0.5
    scale = 1 / (deviation + 0.255)
    standardised = grey * np.float32(scale)
    standardised = standardised - np.float32(mean * scale)
    return np.asarray(standardised, np.float32)
