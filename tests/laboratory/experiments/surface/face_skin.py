"""Judges the skin of a face beyond its distance to the truth: by its normals, and by craters at highlights.

A highlight moves with the camera; matched like skin, it lies behind a convex surface. A crater is a patch that lies
deeper than the surface does around it, by the truth. It counts where a photograph shows a highlight: where one view is
brighter than most views of the same skin.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from pipeline.geometry.projection import depth_maps
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.results.overlays import clay
from rig.mesh import Mesh
from rig.rig import Rig
from rig.studio.scene.visible import PARTS, sample_surface, sees
from tests.laboratory.experiments.paper.detail import Known
from tests.laboratory.experiments.surface.local_means import means_within

PLACE_MM2 = 1.0  # of the true face for each place
SEEN_MM = 2.0  # from a visible point, 1.5 mm apart
NORMAL_MM = 3.0  # over which true normals are means: a scan's facets are coarse
AROUND_MM = 8.0  # radius of what a place is compared with: twice that of most highlights' craters
DEEP_MM = 0.5  # below it is a crater
NEXT_MM = 1.5  # places nearer to each other belong to one crater
MIN_PLACES = 3  # of a crater: mm2
MIN_VIEWS = 3  # of a place: of two, nobody knows which shines
SHINING = 1.3  # times the median view's light, linear
DARK_SHARE = 0.4  # of the face's usual light: below are brows and nostrils, which views see beside skin
GAMMA, LIGHT = 2.2, np.array([0.3, 0.5, 0.2], np.float32)
AZIMUTHS_DEG = (-45.0, 0.0, 45.0)
SHOWN_MM = 1.0  # depth at which the map's red is full
BLUE, RED, GREY = np.array([110.0, 150.0, 255.0]), np.array([225.0, 30.0, 20.0]), np.array([205.0, 205.0, 205.0])


@dataclass(frozen=True, slots=True, eq=False)
class FacePlaces:
    """Holds n places on the true face that two cameras see (world frame, mm), and its normals there."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]


def face_places(known: Known) -> FacePlaces:
    """Draws places on the true face, always the same."""
    skin = known.visible.points[known.visible.part == PARTS.index("head")].astype(float)
    face = Mesh(known.mesh.vertices, known.mesh.faces[known.face[known.mesh.faces].all(axis=1)])
    points, facets = sample_surface(face, PLACE_MM2, np.random.default_rng(0))
    total = means_within(points, NORMAL_MM) @ facets
    normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    seen = KDTree(skin).query(points, distance_upper_bound=SEEN_MM)[0] < SEEN_MM
    return FacePlaces(points[seen], normals[seen])


def normal_figures(places: FacePlaces, found: Mesh) -> dict[str, float]:
    """Returns median and 95th percentile of the angle (degrees) between the true normal and that of the nearest
    triangle."""
    hit = SurfaceIndex(found.vertices, found.faces, 1.0).closest(places.points, facing=places.normals)
    off = np.degrees(np.arccos(np.clip((hit.normals * places.normals).sum(axis=1), -1.0, 1.0)))
    return {"normals_median_deg": float(np.median(off)), "normals_p95_deg": float(np.percentile(off, 95))}


@dataclass(frozen=True, slots=True, eq=False)
class Craters:
    """Holds, for each place, how far it lies below the surface around it (mm; negative above), where a photograph
    shows a highlight, and the number of its crater (-1: none)."""

    depth_mm: Float[np.ndarray, " n"]
    shining: Bool[np.ndarray, " n"]
    crater: Int32[np.ndarray, " n"]

    def figures(self) -> dict[str, float]:
        """Counts craters, and those that touch a highlight; and tells the greatest depth at a highlight."""
        numbers = np.unique(self.crater[self.crater >= 0])
        at_highlights = np.unique(self.crater[(self.crater >= 0) & self.shining])
        return {
            "craters": float(len(numbers)),
            "craters_at_highlights": float(len(at_highlights)),
            "deepest_at_highlight_mm": float(self.depth_mm[self.shining].max(initial=0.0)),
            "highlight_share": float(self.shining.mean()),
        }


def find_craters(places: FacePlaces, found: Mesh, shining: Bool[np.ndarray, " n"]) -> Craters:
    """Finds craters of a surface: patches more than ``DEEP_MM`` below its mean within ``AROUND_MM``, against the
    truth."""
    hit = SurfaceIndex(found.vertices, found.faces, 1.0).closest(places.points, facing=places.normals)
    height = ((hit.points - places.points) * places.normals).sum(axis=1)
    depth = means_within(places.points, AROUND_MM) @ height - height
    deep = np.flatnonzero(depth > DEEP_MM)
    crater = np.full(len(height), -1, np.int32)
    if len(deep):
        touching = means_within(places.points[deep], NEXT_MM)
        label = csgraph.connected_components(touching, directed=False)[1]
        crater[deep] = np.where(np.bincount(label)[label] >= MIN_PLACES, label, -1)
    return Craters(depth, shining, crater)


def shining_places(
    places: FacePlaces, images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]], rig: Rig, true_world: Mesh
) -> Bool[np.ndarray, " n"]:
    """Tells where one view is brighter than ``SHINING`` times the median of the views that see the place, after each
    camera's own gain."""
    depths = depth_maps(rig, true_world)
    light = np.full((len(rig), len(places.points)), np.nan)
    for row, camera in enumerate(rig):
        seen = sees(camera, depths[camera.name], places.points, places.normals)
        light[row, seen] = _light_at(images[camera.name], camera.project(places.points[seen]))
    enough = np.isfinite(light).sum(axis=0) >= MIN_VIEWS
    shining = np.zeros(len(places.points), bool)
    if enough.any():
        usual = np.nanmedian(light[:, enough], axis=0)
        relative = light[:, enough] / usual
        gain = np.array([np.nanmedian(row) if np.isfinite(row).any() else 1.0 for row in relative])
        brightest = np.nanmax(relative / gain[:, None], axis=0)
        shining[enough] = (brightest > SHINING) & (usual > DARK_SHARE * np.median(usual))
    return shining


def _light_at(image: UInt8[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, " n"]:
    """Returns the linear light at pixels, blurred by one pixel."""
    linear = np.power(np.arange(256, dtype=np.float32) / 255.0, GAMMA)[image] @ LIGHT
    smooth = cv2.GaussianBlur(linear, (0, 0), 1.0)
    column, row = np.clip(np.rint(pixels).astype(int), 0, (image.shape[1] - 1, image.shape[0] - 1)).T
    return np.maximum(smooth[row, column], 1e-4)


def crater_map(
    craters: Craters, places_local: Float[np.ndarray, "n 3"], true_local: Mesh
) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the true head (head frame) from its two sides and from the front: highlights blue, what lies deep red,
    whole red from ``SHOWN_MM`` on."""
    far, near = KDTree(places_local).query(true_local.vertices, distance_upper_bound=SEEN_MM)
    known = far < SEEN_MM
    near = np.where(known, near, 0)
    base = np.where((known & craters.shining[near])[:, None], BLUE, GREY)
    red = np.clip((craters.depth_mm[near] - 0.5 * DEEP_MM) / (SHOWN_MM - 0.5 * DEEP_MM), 0.0, 1.0) * known
    colours = np.rint(base + red[:, None] * (RED - base)).astype(np.uint8)
    middle, reach = places_local.mean(axis=0), np.ptp(places_local, axis=0).max() / 2.0
    box = (middle - reach, middle + reach)
    return np.hstack([clay(true_local, colours=colours, azimuth_deg=azimuth, box=box) for azimuth in AZIMUTHS_DEG])
