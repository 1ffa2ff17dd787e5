"""Colours of simulated captures against the truth: the default blend against the paper's, and the background's share.

python -m tests.laboratory.benchmarks.texture_colours --captures 20 --json

Each capture is photographed twice: with exposures alike (``even``), and with exposures that differ by 20 % between the
cameras (``uneven``). It is coloured on the true head, through the true silhouettes, and on the reconstructed one,
through its own; the truth of a vertex is its radiance, highlights left out. PSNR is over the face's vertices that a
camera sees, the hair's edge left out, in codes. Which camera's exposure is the right one, no photograph tells, so that
one gain common to all vertices and channels (linear light, the median ratio) comes first (``raw``: without it).

The background's share of a vertex's colour is measured, not guessed: light adds up, so that the same photographs with
a black and with a lit backdrop, blended with the same weights, differ by exactly that share of the backdrop's light.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry.raster import depth_maps
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, load_model
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.reconstruct import reconstruct
from pipeline.settings import Settings, TextureSettings
from pipeline.stages.context import ReconstructionContext
from pipeline.texturing.vertex_colours import texture
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, build_scene, shoot
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET

SPREAD = 0.2  # of the exposures
SHARES = (0.1, 0.5)  # of background in a vertex's colour
BLENDS = ("default", "reference")
RINGS = 3  # 6 mm: under the hair the truth is the dark skin there, and at its edge the photographs show the hair
SCREEN = 0.5  # linear light of the lit backdrop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first capture")
    parser.add_argument("--detail", choices=("span", "kernel", "photo"), default=None)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    model, rows = load_model(), []
    settings = replace(Settings(), detail=arguments.detail)
    with Renderer.create() as renderer:
        for seed in range(arguments.first, arguments.first + arguments.captures):
            rows.append(measure(seed, model, settings, renderer))
            sys.stderr.write(json.dumps({"seed": seed} | rows[-1]) + "\n")
    found = {name: summary(name, [row[name] for row in rows]) for name in rows[0]}
    if arguments.json:
        json.dump({"captures": len(rows), **found}, sys.stdout)
        sys.stdout.write("\n")
    else:
        sys.stdout.write("".join(f"{name:<36} {value:8.3f}\n" for name, value in found.items()))


def summary(name: str, values: list[float]) -> float:
    """Vertices with background are counted over all captures, gains are the least of all, the rest is a mean."""
    if "background" in name:
        return sum(values)
    return round(float(min(values) if name.endswith("least") else np.mean(values)), 3)


def measure(seed: int, model: HeadModel, settings: Settings, renderer: Renderer) -> dict[str, float]:
    """Figures of one capture."""
    scene = scene_of(seed, model, renderer)
    apart = uneven_exposures(len(scene.views), np.random.default_rng([seed, 1]))
    found: dict[str, float] = {}
    for name, exposures in (("even", np.ones(len(apart))), ("uneven", apart)):
        lit = exposed(scene, exposures)
        capture = shoot(lit, np.random.default_rng([seed, 2]))
        result = reconstruct(ReconstructionContext(capture, scene.rig, model, settings, renderer))
        whole = (result.mesh_world, result.views.silhouettes)
        truth = (scene.head, {key: silhouette_from_mask(view.mask) for key, view in scene.views.items()})
        for label, (mesh, silhouettes) in (("true_head", truth), ("whole", whole)):
            figures = compared(lit, capture, mesh, silhouettes, settings.texture)
            found |= {f"{label}_{name}_{key}": value for key, value in figures.items()}
        if name == "even":
            share = background_share(lit, capture, *whole, settings.texture)
            for least in SHARES:
                found[f"background_over_{least}"] = int(np.count_nonzero(share > least))
    return found


def uneven_exposures(count: int, rng: np.random.Generator) -> Float[np.ndarray, " k"]:
    """Drawn, then scaled, so that they differ from their mean by ``SPREAD`` (RMS of logarithms) in every capture."""
    logs = rng.normal(size=count)
    logs -= logs.mean()
    return np.exp(np.log(1 + SPREAD) / logs.std() * logs)


def scene_of(seed: int, model: HeadModel, renderer: Renderer) -> Scene:
    rng = np.random.default_rng(seed)
    vertices = model.vertices(rng.normal(0, 0.8, 60))
    marks = {name: vertices[row] for name, row in model.landmarks.items()}
    full = model.levels["full"]
    subject = Subject(Mesh(vertices, full.faces), marks, full.face_region, f"subject {seed}")
    return build_scene(subject, default_layout(), PRESET, rng, renderer=renderer)


def exposed(scene: Scene, exposures: Float[np.ndarray, " k"]) -> Scene:
    """The same scene with every camera's gain replaced."""
    sensors = {
        n: replace(v.sensor, gains=(g, g, g)) for (n, v), g in zip(scene.views.items(), exposures.tolist(), strict=True)
    }
    return replace(scene, views={n: replace(v, sensor=sensors[n]) for n, v in scene.views.items()})


def compared(
    scene: Scene,
    capture: Capture,
    mesh: Mesh,
    silhouettes: Mapping[str, Silhouette],
    settings: TextureSettings,
) -> dict[str, float]:
    """PSNR of both blends over the same vertices of the truth, and what the default gains."""
    head = scene.head
    assert head.colours is not None
    assert scene.face_region is not None
    at = SurfaceIndex(mesh.vertices, mesh.faces).closest(head.vertices)
    corners = mesh.faces[at.triangles]
    seen = scene.face_region & ~near(~scene.photographed, head)
    colours: dict[str, np.ndarray] = {}
    depths = depth_maps(scene.rig, mesh)
    for blend in BLENDS:
        chosen = replace(settings, blend=blend)
        found = texture(mesh, mesh.normals(), capture, silhouettes, scene.rig, depths, settings=chosen)
        seen &= (found.views[corners] > 0).all(axis=1)
        colours[blend] = np.einsum("vk,vkc->vc", at.weights, found.colours[corners].astype(float))
    figures: dict[str, float] = {"vertices": int(seen.sum())}
    for blend in BLENDS:
        ours, wanted = colours[blend][seen], head.colours[seen]
        figures[f"{blend}_raw_db"] = psnr(ours, wanted)
        figures[f"{blend}_db"] = psnr(in_gauge(ours, wanted), wanted)
    figures["gain_raw_db"] = figures["default_raw_db"] - figures["reference_raw_db"]
    figures["gain_db"] = figures["gain_db_least"] = figures["default_db"] - figures["reference_db"]
    return figures


def near(vertices: Bool[np.ndarray, " v"], mesh: Mesh) -> Bool[np.ndarray, " v"]:
    """These vertices and those within ``RINGS`` edges of them."""
    for _ in range(RINGS):
        vertices = vertices.copy()
        vertices[mesh.faces[vertices[mesh.faces].any(axis=1)]] = True
    return vertices


def psnr(found: Float[np.ndarray, "n 3"], truth: UInt8[np.ndarray, "n 3"]) -> float:
    return float(10 * np.log10(255**2 / ((found - truth) ** 2).mean()))


def in_gauge(found: Float[np.ndarray, "n 3"], truth: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Codes after the one gain of light, common to all vertices and channels, that brings them nearest."""
    ours, wanted = linear_from_srgb(found / 255.0), linear_from_srgb(truth / 255.0)
    gain = np.median(wanted.sum(axis=1) / np.maximum(ours.sum(axis=1), 1e-4))
    return 255 * srgb_from_linear(gain * ours)


def background_share(
    scene: Scene, capture: Capture, mesh: Mesh, silhouettes: Mapping[str, Silhouette], settings: TextureSettings
) -> Float[np.ndarray, " v"]:
    """Of each vertex's colour, for the silhouettes that the photographs gave and the default blend's own weights."""
    plain = replace(settings, balance=False, outlier=1e9)  # what remains is linear in the light
    light, depths = [], depth_maps(scene.rig, mesh)
    for level in (0.0, SCREEN):
        views = {name: replace(view, backdrop=np.full_like(view.backdrop, level)) for name, view in scene.views.items()}
        dark = replace(scene, views=views, preset=replace(scene.preset, light_drift=0.0))
        noiseless = replace(dark, views={n: replace(v, sensor=replace(v.sensor, noise=0.0)) for n, v in views.items()})
        shot = shoot(noiseless, np.random.default_rng(0))
        found = texture(mesh, mesh.normals(), shot, silhouettes, scene.rig, depths, settings=plain)
        light.append(linear_from_srgb(found.colours / 255.0).mean(axis=1))
    known = found.views > 0
    return np.where(known, np.abs(light[1] - light[0]) / SCREEN, 0.0)


if __name__ == "__main__":
    main()
