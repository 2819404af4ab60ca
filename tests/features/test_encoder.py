"""The encoder: the shipped network, ONNX files and functions of a user, and maps with them."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import WEIGHTS, Encoder, load_encoder
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.storage.tensors import save_tensors
from evercal.typing import Float32Array, Image

from ..encoders import tiny_encoder, tiny_onnx

TEACHER_FILE = WEIGHTS / "encoder-1.onnx"


def image(height: int, width: int, seed: int = 0) -> Image:
    return (
        np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    )


def blocks(grey: Float32Array, stride: int = 8) -> Float32Array:
    """Rows of each cell, added up."""
    rows, columns = (side // stride for side in grey.shape)
    return grey.reshape(rows, stride, columns, stride).sum(1) + 1


def others(grey: Float32Array) -> Float32Array:
    """Features of another function."""
    return blocks(grey) ** 2


@pytest.mark.parametrize("size", [(48, 64), (101, 170)])
def test_onnx_file_is_the_module_that_it_was_made_of(size: tuple[int, int]) -> None:
    torch = pytest.importorskip("torch")
    from training.network import TEACHER, from_onnx

    grey = image(*size)
    with torch.no_grad():
        features = from_onnx(TEACHER_FILE, TEACHER)(
            torch.from_numpy(grey[None, None]) / 255
        )
    expected = features[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(load_encoder(TEACHER_FILE)(grey), expected, atol=1e-5)


def test_weights_in_maps_of_before_are_those_of_the_onnx_file(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from training.network import TEACHER, from_onnx

    state = from_onnx(TEACHER_FILE, TEACHER).half().state_dict()
    path = tmp_path / "encoder-283526ac0c3c.safetensors"
    save_tensors(path, {name: value.numpy() for name, value in state.items()})
    encoder = load_encoder(path)
    shipped = load_encoder(TEACHER_FILE)
    assert encoder.name == shipped.name == "encoder-1.onnx"
    assert encoder.centroids is not None
    np.testing.assert_array_equal(encoder(image(48, 64)), shipped(image(48, 64)))


@pytest.mark.parametrize("size", [(48, 64), (55, 57), (8, 8), (15, 9)])
def test_cells_are_unit_vectors_and_pixels_beyond_whole_cells_are_cut_off(
    size: tuple[int, int],
) -> None:
    (height, width), encoder = size, load_encoder()
    features = encoder(image(height, width))
    assert features.shape == (height // 8, width // 8, encoder.width)
    assert features.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features, axis=2), 1, atol=1e-5)
    cropped = encoder(image(height, width)[: height // 8 * 8, : width // 8 * 8])
    np.testing.assert_array_equal(features, cropped)


def test_brightness_and_contrast_have_little_effect() -> None:
    encoder = load_encoder()
    grey = image(48, 64) // 2 + 32
    for changed in (grey + 60, grey // 2, grey // 2 + 90):
        # Not none: grey levels are whole numbers.
        assert (encoder(grey) * encoder(changed)).sum(2).min() > 0.99
    assert np.isfinite(encoder(np.zeros((16, 16), np.uint8))).all()  # a black image


def test_images_of_any_size_and_colour_are_encoded_at_working_size() -> None:
    encoder = load_encoder()
    grey = image(96, 128)
    colour = np.repeat(grey[..., None], 3, 2)
    large = np.repeat(np.repeat(grey, 2, 0), 2, 1)
    for given in (grey, colour, large):
        np.testing.assert_array_equal(encoder.encode(given, 96), encoder(grey))
    assert encoder.encode(grey, 48).shape[:2] == (6, 8)


@pytest.mark.parametrize("stride", [1, 2, 4, 8, 16])
def test_stride_and_width_are_those_of_what_a_function_makes(stride: int) -> None:
    encoder = load_encoder(lambda grey: blocks(grey, stride))
    assert (encoder.stride, encoder.width) == (stride, stride)
    grey = image(70, 50)
    features = encoder(grey)
    assert features.shape == (70 // stride, 50 // stride, stride)
    np.testing.assert_allclose(np.linalg.norm(features, axis=2), 1, atol=1e-5)
    assert load_encoder(encoder) is encoder


def test_what_is_no_encoder_is_refused() -> None:
    for function in (lambda grey: grey, lambda grey: blocks(grey)[:5]):
        refused(
            function, "must make (rows, columns, channels) with a stride of 1, 2, 4"
        )
    refused("encoder.onnx", "give an ONNX file or a function on arrays")


def test_threads_get_the_same_features() -> None:
    encoder = load_encoder()
    grey = [image(48, 64, seed) for seed in range(12)]
    alone = [encoder(one) for one in grey]
    with ThreadPoolExecutor(4) as pool:
        np.testing.assert_array_equal(list(pool.map(encoder, grey)), alone)
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(encoder))(grey[0]), alone[0]
    )


def test_unusable_files_are_refused(tmp_path: Path) -> None:
    whole = tiny_onnx()
    broken = tmp_path / "broken.onnx"
    for data in (b"", b"hello", whole[: len(whole) // 2]):
        broken.write_bytes(data)
        refused(broken, f"encoder {broken}: ")
    for missing in (tmp_path / "none.onnx", tmp_path):
        refused(missing, f"encoder {missing}: no such file")
    weights = tmp_path / "encoder.safetensors"
    save_tensors(weights, {"project.weight": np.zeros((8, 8), np.float16)})
    refused(weights, "weights of a PyTorch module; export the module to an ONNX file")


def with_encoder(hall_map: MapContents, encoder: Encoder) -> MapContents:
    """`hall_map` with another encoder, which has centroids, and descriptors of its width."""
    vlad = encoder.vlad([encoder(image(96, 96)).reshape(-1, encoder.width)])
    scene = hall_map.scenes[0]
    descriptors = scene.keyframes.descriptors
    assert descriptors is not None
    keyframes = replace(
        scene.keyframes, descriptors=descriptors[:, : vlad.centroids.size]
    )
    return MapContents(
        encoder, hall_map.short_side, [replace(scene, keyframes=keyframes)]
    )


def test_map_keeps_the_name_of_its_function(
    hall_map: MapContents, tmp_path: Path
) -> None:
    contents = with_encoder(hall_map, load_encoder(blocks))
    store = MapStore.create(tmp_path / "map", contents.encoder)
    store.commit(contents.scenes[0], {})
    assert store.networks == ("encoder.json", "vlad.safetensors")
    again = MapStore.open(tmp_path / "map", blocks).contents.encoder
    np.testing.assert_array_equal(again.centroids, contents.encoder.centroids)
    np.testing.assert_array_equal(again(image(48, 48)), contents.encoder(image(48, 48)))
    for given, message in (
        (None, "made with the function 'blocks'; give it as encoder"),
        (others, "encoder others makes other features than 'blocks'"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            MapStore.open(tmp_path / "map", given)
        assert len(str(caught.value).splitlines()) == 1


def test_map_keeps_an_onnx_file_whole(hall_map: MapContents, tmp_path: Path) -> None:
    contents = with_encoder(hall_map, tiny_encoder())
    store = MapStore.create(tmp_path / "map", contents.encoder)
    store.commit(contents.scenes[0], {})
    first, vlad = store.networks
    assert (first[:8], vlad) == (
        "encoder-",
        first.replace("encoder", "vlad")[:-4] + "safetensors",
    )
    assert (tmp_path / "map" / first).read_bytes() == tiny_onnx()
    again = MapStore.open(tmp_path / "map").contents.encoder
    assert (again.name, again.width, again.stride) == (first, 8, 8)
    np.testing.assert_array_equal(again.centroids, contents.encoder.centroids)
    np.testing.assert_array_equal(again(image(48, 48)), contents.encoder(image(48, 48)))


def refused(source: object, message: str) -> None:
    with pytest.raises(InputError, match=r"^encoder") as caught:
        load_encoder(source)  # pyright: ignore[reportArgumentType]
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert message in text
