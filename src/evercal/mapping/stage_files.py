"""The files of a stage in a store: a scene's record and head, and named tensors."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.head import Head, HeadOptions
from evercal.errors import InputError
from evercal.features.encoder import Encoder, checked_encoder
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.frame_correction import FrameCorrection
from evercal.mapping.scene_maps import Alignment, SceneRecord
from evercal.storage.atomic import write_bytes, write_json

HEAD = "head.safetensors"


def own_encoder(module: nn.Module, path: Path) -> Encoder:
    """A user's module with the weights that the store keeps of it.

    Raises:
        InputError: they are of another module.
    """
    try:
        module.load_state_dict({k: v.float() for k, v in load_tensors(path).items()}, strict=True)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise InputError(f"{path}: not the weights of the encoder given ({first})") from None
    return checked_encoder(module)


def head_bytes(head: Head) -> int:
    """Size of a head as it is stored: weights in half precision, centres in single."""
    return sum(value.nbytes for value in _stored(head).values())


def _stored(head: Head) -> dict[str, Tensor]:
    # Centres stay fp32: half floats are 4 to 16 mm apart at the size of an atlas.
    return {
        key: value if key == "centres" or not value.is_floating_point() else value.half()
        for key, value in head.state_dict().items()
    }


def write_head(folder: Path, head: Head) -> None:
    """Into a stage's folder."""
    settings = {
        "options": asdict(head.options),
        "features": head.features,
        "descriptor": head.descriptor,
    }
    save_tensors(folder / HEAD, _stored(head), {"head": json.dumps(settings)})


def read_head(folder: Path, features: int) -> Head:
    """From a stage's folder; `features` is what the store's encoder gives.

    Raises:
        InputError: made with another encoder.
    """
    from safetensors import safe_open

    path = folder / HEAD
    state = load_tensors(path)
    with safe_open(path, "pt") as file:
        settings = json.loads((file.metadata() or {})["head"])
    if settings["features"] != features:
        raise InputError(f"{path}: made with another encoder than the store's")
    options = HeadOptions(**settings["options"])
    return Head.from_state(features, settings["descriptor"], options, state).eval()


def write_record(folder: Path, record: SceneRecord) -> None:
    """Into a stage's folder."""
    content = {
        "name": record.name,
        "camera": record.camera.to_dict(),
        "cell": asdict(record.cell),
        "train_frames": record.train_frames,
        "refined_camera": record.refined_camera.to_dict() if record.refined_camera else None,
        "inlier_threshold": record.inlier_threshold,
        "covariance_scale": record.covariance_scale,
        "min_support": record.min_support,
        "common": record.common.matrix().tolist(),
        "map_sigma": list(record.map_sigma),
    }
    if record.alignment is not None:
        placed = record.alignment
        content["base_from_map"] = placed.base_from_map.matrix().tolist()
        content["map_scale"] = placed.scale
    write_json(folder / "scene.json", content)
    tensors = {"prototypes": record.prototypes}
    if record.bend is not None:
        poses = record.bend.poses
        rows = np.concatenate([poses.rotation_wxyz, poses.translation_m], -1)
        tensors["bend_poses"] = torch.from_numpy(rows)
        tensors["bend"] = torch.from_numpy(record.bend.correction)
        tensors["bend_radius"] = torch.tensor(record.bend.radius, dtype=torch.float64)
    if record.frame_covariance is not None:
        tensors["frame_covariance"] = torch.from_numpy(record.frame_covariance)
    save_tensors(folder / "prototypes.safetensors", tensors)


def read_record(folder: Path) -> SceneRecord:
    """From a stage's folder."""
    content = json.loads((folder / "scene.json").read_text())
    cell, refined = content["cell"], content["refined_camera"]
    tensors = load_tensors(folder / "prototypes.safetensors")
    return SceneRecord(
        content["name"],
        Camera.from_dict(content["camera"]),
        Cell(tuple(cell["centre_m"]), cell["side_m"], tuple(cell["origin_m"])),
        tensors["prototypes"],
        content["train_frames"],
        Camera.from_dict(refined) if refined else None,
        content["inlier_threshold"],
        content["covariance_scale"],
        content["min_support"],
        SE3.from_matrix(content["common"]),
        (content["map_sigma"][0], content["map_sigma"][1]),
        _bend_of(tensors),
        tensors["frame_covariance"].numpy() if "frame_covariance" in tensors else None,
        _alignment_of(content),
    )


def _alignment_of(content: Mapping[str, Any]) -> Alignment | None:
    if "base_from_map" not in content:
        return None
    return Alignment(SE3.from_matrix(content["base_from_map"]), float(content["map_scale"]))


def _bend_of(tensors: Mapping[str, Tensor]) -> FrameCorrection | None:
    if "bend" not in tensors:
        return None
    poses, radius = tensors["bend_poses"].numpy(), tensors["bend_radius"].tolist()
    correction = tensors["bend"].numpy()
    return FrameCorrection(SE3(poses[:, :4], poses[:, 4:]), correction, (radius[0], radius[1]))


def save_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None
) -> None:
    """Writes named tensors, whole or not at all."""
    from safetensors.torch import save

    write_bytes(
        path, save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, metadata)
    )


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Named tensors of a file.

    Raises:
        InputError: not readable.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: not readable ({error}); run 'evercal verify' on the store"
        ) from None
