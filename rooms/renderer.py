"""Path tracing with Mitsuba 3: colour, and depth along the optical axis.

Mitsuba's camera looks along +z with x to the left and y up; ours has OpenCV axes (x right, y down).
Depth is exact: one ray passes through the centre of each pixel.
"""

import glob
import os
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.processes import status_of
from rooms.items import Parts
from rooms.materials import Material
from rooms.shapes import Mesh

_PROBE = """
import drjit as dr, sys; print(flush=True)
dr.set_thread_count(1)
import mitsuba as mi
mi.set_variant(sys.argv[1])
film = {"type": "hdrfilm", "width": 8, "height": 8}
away = mi.ScalarTransform4f().translate([0, 0, -4])
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"},
    "light": {"type": "constant"}, "ball": {"type": "sphere", "bsdf": {"type": "roughplastic"}},
    "sensor": {"type": "perspective", "to_world": away, "film": film}})
assert float(mi.TensorXf(mi.render(scene, spp=1)).array[0]) > 0
"""


@dataclass(frozen=True)
class RenderOptions:
    """Settings of one rendering."""

    samples: int = 16
    """Light paths per pixel."""
    denoise: bool = True
    """Apply Open Image Denoise."""
    exposure_ev: float = 0.0
    """Exposure in stops relative to the default; positive is brighter."""
    noise: float = 0.0
    """Standard deviation of sensor noise at mid grey, as a fraction of full scale."""
    blur_steps: int = 1
    """Poses per exposure that share the samples; 1 disables motion blur."""


@lru_cache(maxsize=1)
def mitsuba() -> Any:
    """Import mitsuba with the fastest working variant, see `choose_variant`.

    EVERCAL_MITSUBA_VARIANT overrides the variant; EVERCAL_RENDER_THREADS limits the threads.

    Raises:
        InputError: Mitsuba is not installed.
    """
    try:
        import drjit as dr  # pyright: ignore[reportMissingImports]
        import mitsuba as mi  # pyright: ignore[reportMissingImports]
        import mitsuba_oidn  # noqa: F401  # pyright: ignore
    except ImportError:
        raise InputError(
            "rendering needs Mitsuba, which is not installed; run:"
            " python -m pip install -c constraints.txt mitsuba mitsuba-oidn"
        ) from None
    variant, _ = choose_variant()
    if "EVERCAL_RENDER_THREADS" in os.environ:
        dr.set_thread_count(int(os.environ["EVERCAL_RENDER_THREADS"]))
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


@lru_cache(maxsize=1)
def choose_variant() -> tuple[str, str]:
    """Mitsuba variant and the reason for it. A subprocess tests each one: a bad LLVM aborts."""
    override = os.environ.get("EVERCAL_MITSUBA_VARIANT")
    if override:
        return override, "set by EVERCAL_MITSUBA_VARIANT"
    for library in _llvm_libraries():
        if _works("llvm_ad_rgb", library):
            os.environ["DRJIT_LIBLLVM_PATH"] = library
            return "llvm_ad_rgb", library
    if _works("cuda_ad_rgb", None):
        return "cuda_ad_rgb", "GPU; no working LLVM"
    return (
        "scalar_rgb",
        "slow; neither a working LLVM >= 16 nor a GPU: apt-get install libllvm19",
    )


def _llvm_libraries() -> list[str]:
    """LLVM libraries to try: the one set by the user, else all installed, newest first."""
    override = os.environ.get("DRJIT_LIBLLVM_PATH")
    if override:
        return [override]
    folders = (
        "/usr/lib/*/libLLVM*.so*",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*",
    )
    versions = {}
    for path in {
        os.path.realpath(path) for folder in folders for path in glob.glob(folder)
    }:
        if digits := re.search(r"\d+", os.path.basename(path)):
            versions.setdefault(int(digits[0]), path)
    # Older versions lack opaque pointers or abort on processors with AVX-512.
    return [
        versions[version] for version in sorted(versions, reverse=True) if version >= 16
    ]


def _works(variant: str, library: str | None) -> bool:
    environment = {**os.environ, **({"DRJIT_LIBLLVM_PATH": library} if library else {})}
    return status_of(_PROBE, variant, seconds=120, environment=environment) == 0


class Renderer:
    """Renders a set of meshes from any pose.

    Meshes of one material are merged for speed; a mesh with a `name` stays separate and can be
    moved. The exposure is a factor on radiance.
    """

    def __init__(self, meshes: Parts, exposure: float = 2.0):
        mi = self._mi = mitsuba()
        self._exposure = exposure
        self._sensors: dict[Camera, tuple[Any, Any]] = {}
        scene: dict[str, Any] = {
            "type": "scene",
            # Two bounces. Russian roulette from the first one halves the time for little noise.
            "integrator": {"type": "path", "max_depth": 4, "rr_depth": 1},
        }
        groups: dict[tuple[str, str], tuple[Material, list[Mesh]]] = {}
        for mesh, material in meshes:
            key = (material.name, mesh.name)
            groups.setdefault(key, (material, []))[1].append(mesh)
        for number, ((_, name), (material, members)) in enumerate(groups.items()):
            scene[name or f"static{number}"] = _mesh(mi, Mesh.merged(members), material)
        self._scene = mi.load_dict(scene)
        self._features = mi.load_dict(
            {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
        )
        self._parameters = mi.traverse(self._scene)

    def move(self, moved: Parts) -> None:
        """Replace vertices and normals of named meshes, in the base frame."""
        for mesh, _ in moved:
            self._replace(f"{mesh.name}.vertex_positions", mesh.vertices_m)
            self._replace(f"{mesh.name}.vertex_normals", mesh.normals)
        self._parameters.update()

    def _replace(self, key: str, value: np.ndarray) -> None:
        flat = np.ascontiguousarray(value, np.float32).ravel()
        self._parameters[key] = type(self._parameters[key])(flat)

    def render(
        self,
        camera: Camera,
        base_from_camera: SE3,
        options: RenderOptions | None = None,
        seed: int = 0,
    ) -> np.ndarray:
        """Render one image.

        A batch of poses (n,) base_from_camera is a motion during the exposure. One variant gives
        the same pixels for the same seed. Returns sRGB (H, W, 3) uint8.

        Raises:
            ValueError: The camera has distortion, or fx and fy differ.
        """
        options = options or RenderOptions()
        poses = list(base_from_camera) if base_from_camera.shape else [base_from_camera]
        sensor, parameters = self._sensor(camera)
        share = max(1, options.samples // len(poses))
        light = np.zeros((camera.height, camera.width, 3), np.float32)
        features = np.zeros((camera.height, camera.width, 6), np.float32)
        for i, pose in enumerate(poses):
            matrix = pose.matrix() @ np.diag([-1.0, -1.0, 1.0, 1.0])
            parameters["to_world"] = self._mi.Transform4f(matrix)
            parameters.update()
            how = {"sensor": sensor, "seed": (seed * 31 + i) % 2**32}
            light += np.asarray(self._mi.render(self._scene, spp=share, **how))[..., :3]
            if options.denoise:
                few = min(share, 4)
                aov = self._mi.render(
                    self._scene, integrator=self._features, spp=few, **how
                )
                features += np.asarray(aov)[..., -6:]
        if options.denoise:
            light = _denoised(light / len(poses), features / len(poses))
        else:
            light /= len(poses)
        radiance = light.astype(float) * self._exposure * 2.0**options.exposure_ev
        return _encode(radiance, options.noise, np.random.default_rng([seed, 1]))

    def depth(self, camera: Camera, base_from_camera: SE3) -> np.ndarray:
        """Depth along the optical axis, float32 metres, shape (H, W); 0 for a miss."""
        mi = self._mi
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        rays = camera.unproject(np.stack([u, v], -1).reshape(-1, 2))
        length = np.linalg.norm(rays, axis=-1)
        directions = (rays / length[:, None]) @ base_from_camera.rotation_matrix().T
        origin = base_from_camera.translation_m
        if mi.variant().startswith("scalar"):
            start = mi.Point3f(*origin.tolist())
            hits = [
                self._scene.ray_intersect_preliminary(
                    mi.Ray3f(start, mi.Vector3f(*ray.tolist()))
                ).t
                for ray in directions
            ]
            distance = np.array(hits, np.float64)
        else:
            # Arrays: a constant would compile a new kernel for every frame.
            starts = np.broadcast_to(origin[:, None], (3, len(rays))).astype(np.float32)
            ray = mi.Ray3f(
                mi.Point3f(starts), mi.Vector3f(directions.T.astype(np.float32))
            )
            hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
            distance = np.array(hit.t, np.float64)
        depth = np.where(
            np.isfinite(distance) & (distance < 1e6), distance / length, 0.0
        )
        return depth.reshape(camera.height, camera.width).astype(np.float32)

    def _sensor(self, camera: Camera) -> tuple[Any, Any]:
        """Sensor of a camera and its parameters, cached so that kernels are compiled once."""
        if camera not in self._sensors:
            if any(camera.distortion) or abs(camera.fx - camera.fy) > 1e-6 * camera.fx:
                raise ValueError(
                    f"rendering needs a pinhole with fx = fy, got {camera}"
                )
            width = camera.width
            height = camera.height
            film = {"type": "hdrfilm", "width": width, "height": height}
            film |= {"rfilter": {"type": "box"}, "component_format": "float32"}
            sensor = self._mi.load_dict(
                {
                    "type": "perspective",
                    "fov": float(np.degrees(2 * np.arctan(width / 2 / camera.fx))),
                    "fov_axis": "x",
                    "near_clip": 0.01,
                    "far_clip": 1000.0,
                    "principal_point_offset_x": ((width - 1) / 2 - camera.cx) / width,
                    "principal_point_offset_y": ((height - 1) / 2 - camera.cy) / height,
                    "film": film,
                    "sampler": {"type": "multijitter", "sample_count": 16},
                }
            )
            self._sensors[camera] = (sensor, self._mi.traverse(sensor))
        return self._sensors[camera]


def _denoised(light: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Radiance (H, W, 3) without noise; `features` are albedo and normal of the first surface."""
    import mitsuba_oidn as oidn  # pyright: ignore[reportMissingImports]

    albedo = np.ascontiguousarray(np.clip(features[..., :3], 0, 1))
    normal = np.ascontiguousarray(features[..., 3:])
    return np.asarray(oidn.denoise(light, albedo, normal, hdr=True))


def _encode(radiance: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Radiance to sRGB bytes with a soft shoulder for highlights."""
    knee = 0.7
    over = np.maximum(radiance - knee, 0.0)
    linear = np.minimum(radiance, knee) + (1 - knee) * (1 - np.exp(-over / (1 - knee)))
    return sensor_bytes(linear, noise, rng)


def sensor_bytes(
    linear: np.ndarray, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Linear light in [0, 1] to sRGB bytes with sensor noise, see `RenderOptions`."""
    if noise > 0:  # shot noise grows with the square root of the light
        sigma = noise * np.sqrt(np.clip(linear, 0.01, 1.0) / 0.2)
        linear = linear + sigma * rng.standard_normal(linear.shape)
    linear = np.clip(linear, 0.0, 1.0)
    curve = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    )
    return np.round(curve * 255).astype(np.uint8)


def _mesh(mi: Any, mesh: Mesh, material: Material) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material.bsdf(mi))
    light = material.emitter()
    if light is not None:
        properties["emitter"] = mi.load_dict(light)
    name = mesh.name or material.name
    counts = (len(mesh.vertices_m), len(mesh.faces))
    extras = {"has_vertex_normals": True, "has_vertex_texcoords": True}
    result = mi.Mesh(name, *counts, **extras, props=properties)
    parameters = mi.traverse(result)
    for key, value, kind in (
        ("vertex_positions", mesh.vertices_m, np.float32),
        ("vertex_normals", mesh.normals, np.float32),
        ("vertex_texcoords", mesh.uv / material.tile_m, np.float32),
        ("faces", mesh.faces, np.uint32),
    ):
        flat = np.ascontiguousarray(value, kind).ravel()
        parameters[key] = type(parameters[key])(flat)
    parameters.update()
    return result
