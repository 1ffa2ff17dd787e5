"""Computes the signed distance to the subject's surface on a sparse grid, from depth maps, silhouettes and the fitted
head.

At every node each view contributes the distance to the surface that it sees, and free space in front of it
(``vote_kernels``). Silhouettes bound the subject from outside. Between measured nodes a smooth field interpolates
(``grid_kernels``). Unseen regions follow the fitted head and the visual hull. The grid is refined from a coarse box to
the requested spacing; each finer level has nodes only near the surface of the coarser level.

The method follows Curless and Levoy, *A volumetric method for building complex models from range images*, SIGGRAPH
1996. Other than in their method, views are combined robustly, and silhouettes are inequality constraints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.compute.threads import in_threads
from pipeline.compute.trace import traced
from pipeline.fusion import grid_kernels
from pipeline.fusion.grid import Grid, at_points, everywhere, marked_box, refined, whole_box
from pipeline.fusion.grid_kernels import Membrane, relax
from pipeline.fusion.hair import Places, distance_to_shell
from pipeline.fusion.prior import EAR_SPARED_MM, SeenSurface, distance_about_ears, distance_to_subject, near_rim
from pipeline.fusion.rim import rim_of
from pipeline.fusion.view_stack import ALONE_FACTOR, VIEWS_SURE, ViewStack
from pipeline.fusion.vote_kernels import CENTRE, vote
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.stereo.depth_map import DepthMap, points_world
from rig.errors import EigenheadError
from rig.mesh import Mesh
from rig.messages.message import compose

ROUND_MM = 12.0  # standard deviation of the blur that rounds the edges between photographs' ends
SPARED_MM = 4.0  # outside of photographs' ends that the bust may reach: the blur takes about as much off
FAR_MM = 100.0  # distances count up to this one
ONE_SIDED = 0.3  # length of the mean direction to the cameras above which nobody stands behind the subject
BEHIND_QUANTILE, THICK_QUANTILE = 0.998, 0.9  # of seen points (to the front, too), and of their heights: the hair
MIN_ENDED = 0.4  # of the rim, ended by outlines: people16's masks .67 and .70; where photographs end the bust, .15
OUT_QUANTILE = 0.95  # of an ear's vertices: so far it stands out of its outlines
FLATTEST = 0.25  # share of its height by which such an ear is laid flat at most
HEAD_EVERY = 4  # vertices of the head stand for the others
Field = Float32[np.ndarray, " n"]
Points = Float[np.ndarray, "m 3"]

COARSEST_MM = 5.0  # the first level's step is at least this: the whole box then has half a million nodes
# Steps before and behind a surface within which its distance counts: the inside of a shoulder is no thicker.
REACH, BEHIND = 1.5, 2.5
AGREEMENT = 1.0  # steps (and at least a millimetre) within which votes are of one surface
UNIT_STEPS, FLOOR_MM = 1 / 3, 0.1  # a vote of the first deviation weighs one; none is better than the second
DATA_WEIGHT = 10.0  # of a vote, by that of one edge of the membrane
BLEND_MM = 1.5  # from the edge of what is seen to where the guess prevails: its weight is (step / that)^2
UNDECIDED_BLEND_MM = 150.0  # the same where there is hardly a guess
SWEEPS, FINE_SWEEPS = 60, 16
FACTOR, FINE_FACTOR = 1.8, 1.4  # of over-relaxation
WEAK = 1.0  # votes of less weight are drawn to the guess, too: chance matches of two views are among them
EVERY = 7  # known pixel is used to tell where a surface may be
THINNED = 10  # of these tell how far the surface lies from head and hull
WIDENINGS = 4  # of a grid by one coarse step
STRAYS = 0.1  # per cent of these that may lie outside of the box
UNSEEN_DEPTH_MM = 200.0  # of a body beyond what is seen of it, at most


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Holds, at nodes of a dense box, the signed distance (mm, positive outside) to the end of the bust."""

    box: Grid
    beyond_mm: Float[np.ndarray, " n"]
    before_mm: Float[np.ndarray, " n"] | None = None  # how far nodes below the head lie before its chest; else -inf

    def distance_mm(self, places: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Returns the signed distance (mm, negative inside) of points to the surface at which the bust ends."""
        return at_points(self.box, self.beyond_mm, places)


@traced
def find_cut(box: Grid, views: ViewStack, seen: Float[np.ndarray, "m 3"], head_world: Mesh | None) -> Cut:
    """Determines the surface at which the bust ends: a smooth surface near the borders of photographs or masks, and a
    plane behind the seen surface. The smooth surface avoids edges where the borders of several photographs meet; the
    plane removes unseen parts of the visual hull behind neck and shoulders.

    Args:
        box: a whole box of nodes.
        views: the cameras and their photographs' edges.
        seen: points of the seen surface, world frame, mm.
        head_world: the fitted head; without a head only the borders of photographs are used.
    """
    from scipy.ndimage import gaussian_filter  # 0.05 s

    places = box.places()
    edges_mm = np.sort(views.outside(places)[0], axis=0)
    frames = np.clip(edges_mm[min(1, len(edges_mm) - 1)], -FAR_MM, FAR_MM)  # of all cameras but one
    beyond = gaussian_filter(frames.reshape(box.shape), ROUND_MM / box.step_mm).ravel() - SPARED_MM
    if head_world is None:
        return Cut(box, beyond)
    vertices = head_world.vertices[::HEAD_EVERY]
    tree, low = PointTree.of(vertices), near_rim(head_world, vertices)
    far, near = nearest(tree, seen)
    if low[near].all() or not low[near].any():
        return Cut(box, beyond)
    below, down = low[near], vertices[low].mean(axis=0) - vertices.mean(axis=0)
    under = low[nearest(tree, places)[1]]
    rim = rim_of(seen[below], vertices.mean(axis=0), down / np.linalg.norm(down))
    if rim is not None and rim.share_ended(views) > MIN_ENDED:
        beyond = np.maximum(beyond, np.where(under, rim.beyond_mm(places), -np.inf))
    towards = views.cameras[:, CENTRE:] - np.median(seen, axis=0)
    before = None
    back = -(towards / np.linalg.norm(towards, axis=1, keepdims=True)).mean(axis=0)
    if np.linalg.norm(back) > ONE_SIDED:
        back /= np.linalg.norm(back)
        end = max(np.quantile(seen[below] @ back, BEHIND_QUANTILE), (vertices[low] @ back).max())
        head_end = (vertices @ back).max() + np.quantile(far[~below], THICK_QUANTILE)
        beyond = np.maximum(beyond, places @ back - np.where(under, end, head_end))
        chest = min(np.quantile(seen[below] @ back, 1.0 - BEHIND_QUANTILE), (vertices[low] @ back).min())
        before = np.where(under, chest - places @ back, -np.inf)
    return Cut(box, beyond, before)


class NoSurface(EigenheadError):
    """Reports that the photographs determine no surface: too few views have depth, or they contradict each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Holds the combined measurements of all views at every node of a grid: the signed distance to the surface (mm),
    its weight (above 0 only if a view sees the node), and a lower bound (mm) from the silhouettes.
    ``vote_kernels.vote`` computes them."""

    value: Field
    weight: Field
    bound: Field


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Holds the solution on one grid: the signed distance (mm, negative inside) at each node."""

    grid: Grid
    field: Field


def solve_level(grid: Grid, votes: Votes, start: Field, sweeps: int, factor: float) -> Level:
    """Computes the signed distance on one grid. The signed distance follows the views' votes, is positive outside the
    silhouettes, and tends to ``start`` where hardly any view sees a node. ``sweeps`` and ``factor`` are parameters of
    the relaxation."""
    reach = np.float32(REACH * grid.step_mm)
    start = np.clip(start, -reach, reach)
    blend = np.where(votes.weight < 0, UNDECIDED_BLEND_MM, BLEND_MM)
    held = np.where(votes.weight < WEAK, (grid.step_mm / blend) ** 2, 0.0)
    data = DATA_WEIGHT * np.maximum(votes.weight, 0.0)
    pull = (held + data).astype(np.float32)
    target = ((held * start + data * votes.value) / pull).astype(np.float32)
    field = np.where(grid.outer, start, np.maximum(target, votes.bound)).astype(np.float32)
    free, odd = ~grid.outer & (votes.bound < reach), (np.bitwise_xor.reduce(grid.index, axis=1) & 1) == 1
    colours = [np.flatnonzero(free & ~odd).astype(np.int32), np.flatnonzero(free & odd).astype(np.int32)]
    membrane = Membrane(target, pull, votes.bound)
    for sweep in range(2 * sweeps):
        rows = colours[sweep % 2]

        def sweep_nodes(first: int, last: int, rows: np.ndarray = rows) -> None:
            relax(field, membrane, rows, grid.neighbours, factor, first, last)

        in_threads(len(rows), sweep_nodes)
    return Level(grid, field)


def combine_views(grid: Grid, views: ViewStack) -> Votes:
    """Combines the views at every node of the grid."""
    step = grid.step_mm
    value, weight, bound = (np.zeros(len(grid), np.float32) for _ in range(3))
    limits = np.array([REACH * step, BEHIND * step, max(1.0, AGREEMENT * step), UNIT_STEPS * step, FLOOR_MM])
    packed = views.packed()

    def fill(first: int, last: int) -> None:
        vote(grid.index, grid.corner, step, packed, limits, value, weight, bound, first, last)

    in_threads(len(grid), fill)
    return Votes(value, weight, bound)


def add_bust_end(votes: Votes, grid: Grid, cut: Cut) -> Votes:
    """Adds the surface at which the bust ends to the lower bounds of the votes."""
    reach = REACH * grid.step_mm
    beyond = np.clip(cut.distance_mm(grid.places()), -reach, reach).astype(np.float32)
    return replace(votes, bound=np.maximum(votes.bound, beyond))


@dataclass(frozen=True, slots=True, eq=False)
class HeadEars:
    """Holds ears that are copied from the fitted head, since depth maps show only fragments of them."""

    head_world: Mesh
    around: Points  # vertices of such ears, as they were and as they lie: about them depth does not count

    @classmethod
    def of(cls, head_world: Mesh, ears: Sequence[Bool[np.ndarray, " v"]], views: ViewStack) -> "HeadEars":
        """Flattens the head's ears until they lie inside the silhouettes. ``ears``: vertex mask of each ear."""
        placed, around = head_world.vertices.copy(), list[Points]()
        for ear in ears:
            way = placed[ear].mean(axis=0) - placed.mean(axis=0)
            way /= np.linalg.norm(way)
            height = placed[ear] @ way  # pictures are known to a few millimetres beside the subject
            height -= height.min()
            edges_mm, outlines_mm = views.outside(placed[ear])
            out_mm = np.quantile(np.where(edges_mm > 0.0, 0.0, outlines_mm).max(axis=0), OUT_QUANTILE)
            placed[ear] -= np.clip(out_mm / height.max(), 0.0, FLATTEST) * height[:, None] * way
            around += [head_world.vertices[ear], placed[ear]]
        return cls(Mesh(placed, head_world.faces), np.concatenate(around))

    def replace_votes(self, grid: Grid, votes: Votes, start: Field) -> tuple[Votes, Field]:
        """Removes the votes near the ears, and sets the start field near the ears to the distance to the head."""
        rows, distance = distance_about_ears(self.head_world, self.around, grid.places())
        inner = ~grid.outer[rows]
        rows, distance = rows[inner], distance[inner]
        weight, bound, start = votes.weight.copy(), votes.bound.copy(), start.copy()
        weight[rows], start[rows] = 0.0, distance
        bound[rows] -= EAR_SPARED_MM
        return replace(votes, weight=weight, bound=bound), start


@traced
def solve(
    depth_maps: Sequence[DepthMap],
    views: ViewStack,
    head_world: Mesh | None,
    spacing_mm: float,
    hair: Places | None = None,
    ears: HeadEars | None = None,
) -> tuple[Level, Cut]:
    """Computes the signed distance near the surface, on a sparse grid with a step of ``spacing_mm``, from coarse to
    fine. ``hair`` is hair without measured depth, ``ears`` are ears with depth in fragments only."""
    halvings = 1
    while spacing_mm * 2**halvings < COARSEST_MM:
        halvings += 1
    seen = np.concatenate([points_world(depth_map)[::EVERY] for depth_map in depth_maps])
    agreed = np.concatenate([depth_map.views[depth_map.known][::EVERY] for depth_map in depth_maps])
    shown = seen
    if hair is not None:
        shown = np.concatenate([seen, hair])
        agreed = np.concatenate([agreed, np.full(len(hair), VIEWS_SURE)])
    grid = whole_box(*_box(depth_maps, shown, spacing_mm * 2**halvings), spacing_mm * 2**halvings)
    votes, known = combine_views(grid, views), shown[::THINNED]
    hull_mm, cut = at_points(grid, votes.bound, known), find_cut(grid, views, known, head_world)
    votes = add_bust_end(votes, grid, cut)
    weight = np.where(agreed[::THINNED] < VIEWS_SURE, ALONE_FACTOR**-2, 1.0)
    guess = _prior(grid, votes, head_world, SeenSurface(known, hull_mm, weight), views, cut)
    if hair is not None:
        shell, outside = distance_to_shell(hair, views, grid)  # of hair, where photographs show its outside
        mixed = outside * np.maximum(shell, votes.bound) + (1.0 - outside) * guess
        guess = np.where(grid.outer | (votes.weight >= WEAK), guess, mixed).astype(np.float32)
    if ears is not None:
        votes, guess = ears.replace_votes(grid, votes, guess)
        seen = np.concatenate([seen, ears.around])
    level = solve_level(grid, votes, guess, SWEEPS, FACTOR)
    box = level.field.reshape(grid.shape)
    for halving in range(halvings):
        wanted = grid_kernels.grown(marked_box(level.grid, grid_kernels.crossed(level.field, level.grid.neighbours)))
        level = _finer(level.grid, box, wanted | _near_points(level.grid, seen), views, cut, ears)
        if halving < halvings - 1:
            box = everywhere(level.grid, level.field, box)
    return level, cut


def _finer(
    coarse: Grid,
    box: Float32[np.ndarray, "nx ny nz"],
    wanted: Bool[np.ndarray, "nx ny nz"],
    views: ViewStack,
    cut: Cut,
    ears: HeadEars | None,
) -> Level:
    """Computes the signed distance at half the step around the ``wanted`` nodes. ``cut`` is the end of the bust. The
    grid is widened while the surface leaves it; raises NoSurface if it still does after ``WIDENINGS`` rounds."""
    for _ in range(WIDENINGS + 1):
        grid = refined(coarse, wanted)
        start = grid_kernels.interpolated(box, grid.index)
        votes = add_bust_end(combine_views(grid, views), grid, cut)
        if ears is not None:
            votes, start = ears.replace_votes(grid, votes, start)
        level = solve_level(grid, votes, start, FINE_SWEEPS, FINE_FACTOR)
        if not grid_kernels.crossed_at_rim(level.field, grid.neighbours, grid.outer):
            return level
        wanted = grid_kernels.grown(wanted)
    raise NoSurface(compose("depth-contradictory"))


def _box(
    depth_maps: Sequence[DepthMap], seen: Points, step_mm: float
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Returns the corner and the edges (mm, world frame) of a box around the seen points and the unseen body behind
    them."""
    low, high = np.percentile(seen, [STRAYS, 100 - STRAYS], axis=0)
    behind = np.array([depth_map.camera.axis_world for depth_map in depth_maps]) * UNSEEN_DEPTH_MM
    middle = np.median(seen, axis=0)
    far = middle + behind
    low = np.minimum(low, np.maximum(far.min(axis=0), low - UNSEEN_DEPTH_MM)) - 4 * step_mm
    high = np.maximum(high, np.minimum(far.max(axis=0), high + UNSEEN_DEPTH_MM)) + 4 * step_mm
    return low, high - low


def _prior(grid: Grid, votes: Votes, head_world: Mesh | None, seen: SeenSurface, views: ViewStack, cut: Cut) -> Field:
    """Returns the signed distance from which the relaxation starts. The start value is the measured distance where
    views certainly see the surface, and elsewhere the distance to the surface predicted from visual hull and head."""
    prior = np.maximum(votes.value, votes.bound).astype(float)
    if head_world is not None:
        weak = (votes.weight > 0) & (votes.weight < WEAK) & (votes.bound < 0)
        guessed = weak | ((votes.weight <= 0) & (prior < 0))
        hull = np.where(weak, votes.bound, prior)[guessed]
        places = grid.places(guessed)
        guess = distance_to_subject(places, hull, head_world, seen, views.cameras[:, CENTRE:])
        if cut.before_mm is not None:
            guess = np.maximum(guess, np.where(weak[guessed], -np.inf, cut.before_mm[guessed]))
        prior[guessed] = np.where(weak[guessed] & np.isneginf(guess), prior[guessed], np.maximum(hull, guess))
    prior[grid.outer] = REACH * grid.step_mm
    return prior.astype(np.float32)


def _near_points(grid: Grid, points: Points) -> Bool[np.ndarray, "nx ny nz"]:
    """Marks the nodes of cells that contain a seen point, and their neighbours, in a dense volume."""
    box = np.zeros(grid.shape, bool)
    at = np.floor((points - grid.corner) / grid.step_mm).astype(int)
    inside = ((at >= 1) & (at < np.array(grid.shape) - 1)).all(axis=1)
    box[tuple(at[inside].T)] = True
    return grid_kernels.grown(box)
