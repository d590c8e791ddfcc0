"""Light and exact views of a bed, path traced by Mitsuba 3."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mushpipe import Camera
from mushpipe.core.arrays import Floats, Ints, Singles
from training.traced.bed import Bed
from training.traced.mesh import Mesh, joined

BOUNCES = 6


@dataclass(frozen=True, eq=False)
class View:
    """What a perfect camera sees.

    Attributes:
        light: (H, W, 3) linear RGB.
        depth: (H, W) m along the optical axis, infinite beyond the bed.
        slant: (H, W) cosine between surface and line of sight.
        owner: (H, W) row of the mushroom whose skin is seen, -1 for none.
    """

    light: Singles
    depth: Floats
    slant: Floats
    owner: Ints


def seen(bed: Bed, points: Floats) -> Floats:
    """Return points (N, 3) of the bed frame in the optical frame."""
    return np.asarray(points @ bed.rotation.T + [0, 0, bed.distance])


def traced(bed: Bed, camera: Camera, samples: int, seed: int) -> View:
    """Return the view of a bed, of so many paths per pixel."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng([seed, 1])
    skin, dull = (_surface(mi, roughness) for roughness in (0.35, 0.8))
    skins = [_shape(mi, bed, m.skin, skin) for m in bed.mushrooms]
    rest = joined([bed.ground] + [m.rest for m in bed.mushrooms if m.rest])
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": _sensor(mi, camera),
            "rest": _shape(mi, bed, rest, dull),
            **{f"skin{k}": shape for k, shape in enumerate(skins)},
            **_lamps(bed, rng),
        }
    )
    path = mi.load_dict({"type": "path", "max_depth": BOUNCES})
    light = np.array(mi.render(scene, integrator=path, spp=samples, seed=seed), np.float32)
    return View(light[..., :3], *_exact(mi, scene, skins, camera))


def _exact(mi: Any, scene: Any, skins: list[Any], camera: Camera) -> tuple[Floats, Floats, Ints]:
    """Return depth, slant and owner of `View`, on the ray through the middle of each pixel."""
    import drjit as dr

    shape = camera.height, camera.width
    rows, columns = np.indices(shape, float)
    pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    sight = camera.deproject(pixels, np.ones(len(pixels)))
    far = np.linalg.norm(sight, axis=1)
    unit = mi.Vector3f(np.asarray(sight / far[:, None], np.float32).T)
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0), unit))
    number = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
    owner = np.full(len(pixels), -1)
    for k, skin in enumerate(skins):
        owner[number == np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(skin)))[0]] = k
    depth = np.where(np.array(hit.is_valid()), np.array(hit.t) / far, np.inf)
    slant = np.abs(np.array(dr.dot(hit.sh_frame.n, unit)))
    return depth.reshape(shape), slant.reshape(shape), owner.reshape(shape)


def _sensor(mi: Any, camera: Camera) -> dict[str, Any]:
    """Return a pinhole at the origin of the optical frame, its principal point in the middle."""
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height}
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
        "film": film | {"rfilter": {"type": "box"}, "component_format": "float32"},
        "sampler": {"type": "independent"},
    }


def _surface(mi: Any, roughness: float) -> Any:
    """Return a material that has the colours of a mesh."""
    colors = {"type": "mesh_attribute", "name": "vertex_color"}
    skin = {"type": "principled", "base_color": colors, "roughness": roughness, "specular": 0.4}
    return mi.load_dict({"type": "twosided", "skin": skin})


def _shape(mi: Any, bed: Bed, mesh: Mesh, surface: Any) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = surface
    sizes = len(mesh.vertices), len(mesh.triangles)
    shape = mi.Mesh("", *sizes, has_vertex_normals=True, props=properties)
    shape.add_attribute("vertex_color", 3, np.ravel(mesh.colors).astype(np.float32))
    values = mi.traverse(shape)
    values["vertex_positions"] = np.ravel(seen(bed, mesh.vertices)).astype(np.float32)
    values["faces"] = np.ravel(mesh.triangles).astype(np.uint32)
    values.update()
    shape.recompute_vertex_normals()
    return shape


def _lamps(bed: Bed, rng: np.random.Generator) -> dict[str, Any]:
    """Return the lamps over a bed: a pair of bars, a ring around the camera, a low bar, a spot."""
    tint = np.array([1, rng.uniform(0.85, 1), rng.uniform(0.65, 1.1)])
    even = {"type": "rgb", "value": (rng.uniform(0.05, 0.5) * tint).tolist()}
    lamps: dict[str, Any] = {"sky": {"type": "constant", "radiance": even}}
    kind = rng.choice(["bars", "ring", "low", "spot"], p=[0.4, 0.25, 0.2, 0.15])
    across, height = bed.distance * rng.uniform(0.5, 1.0), bed.distance * rng.uniform(0.7, 1.3)
    turn = rng.uniform(0, 2 * np.pi)
    if kind == "ring":
        places = [(0.06 * np.cos(a), 0.06 * np.sin(a), bed.distance) for a in np.arange(0, 6.2, 1)]
        size = 0.008
    elif kind == "bars":
        c, s = np.cos(turn), np.sin(turn)
        line = np.linspace(-0.3, 0.3, 9)
        places = [(g * c - t * s, g * s + t * c, height) for g in (across, -across) for t in line]
        size = 0.012
    else:
        low = height * (0.35 if kind == "low" else 1)
        places, size = [(across * np.cos(turn), across * np.sin(turn), low)], 0.02
    for k, place in enumerate(places):
        center = seen(bed, np.array([place]))[0]
        glow = {"type": "rgb", "value": (tint / len(places) / size**2).tolist()}
        lamps[f"lamp{k}"] = {
            "type": "sphere",
            "center": center.tolist(),
            "radius": size,
            "emitter": {"type": "area", "radiance": glow},
        }
    return lamps
