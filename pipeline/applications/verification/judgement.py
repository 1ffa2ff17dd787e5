"""Computes the figures of a verification after the standard VDI/VDE 2634 part 3, with a mannequin head in place of the
standard's spheres.

Deviations are signed distances (mm, positive outside) from the reference scan to a measured head's vertices after the
best fit, weighted by vertex area. Vertices are not judged if their closest point lies at the scan's open edge or
farther than 10 mm away; the fraction of judged area is reported.

- The probing error of form is the range that contains the deviations of 99.7 % of the face's area.
- The probing error of size is the scale of the best fit minus 1, in percent.
- The distance error compares distances between landmarks: measured minus reference. Distances between landmarks need no
  alignment.
- The repeatability is the scatter of the heads over repeated captures (``repeatability``). The limit of repeatability
  applies to the scatter along the normal, because sliding of a vertex along the surface does not change the shape.
- Errors by region are mean, RMS, median and 95th percentile, also of the mean deviation over all captures
  (``repeated``).

Repeatability is computed from heads of one subject captured several times. All heads have corresponding vertices, which
are compared. The heads are aligned by rigid motions, without scale, to their mean over the given vertices, and the mean
is recomputed (generalised Procrustes analysis without scale; Gower 1975, https://doi.org/10.1007/BF02291478).

The default limits are about one and a half times the values that a bare mannequin from outside the head model's
population gives in the simulated studio (tests/laboratory/notes/verification.md). With these limits rigs without faults
pass, and rigs with a permanent fault do not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import rankdata

from pipeline.applications.verification.best_fit import BestFit, align_face, counted
from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.reference import Reference
from pipeline.evidence.measurements import DISTANCES
from pipeline.head_model.regions import REGIONS
from rig.errors import InputError
from rig.geometry import rigid_fit
from rig.mesh import vertex_normals

ROUNDS = 20  # of aligning and averaging; three are usual
STILL_MM = 1e-7  # a mean that moves by less is the mean

FORM_SHARE = 0.997  # of the area; the rest are outliers, as three of a thousand points
FEATURES = ("eyes", "nose", "mouth")
MIN_COVERED = 0.2  # share of a region, below which it has no figures
MIN_FACING = 0.5  # share of the judged face where both surfaces face the same way


@dataclass(frozen=True, slots=True)
class Limits:
    """Holds the limit of each verification figure: the largest allowed value, for ``least_covered`` the smallest."""

    face_rms_mm: float = 0.35  # deviation from the reference, of any capture
    features_rms_mm: float = 0.8  # the same of eyes, nose and mouth, the worst of them
    probing_form_mm: float = 4.5  # range of the deviations of 99.7 % of the face
    size_error_percent: float = 0.3
    distance_mm: float = 5.0  # RMS of the landmark distances: what nothing fixes along the surface slides
    repeatability_mm: float = 0.2  # scatter over the face along its normal, RMS
    least_covered: float = 0.9  # share of the face that the reference covers


@dataclass(frozen=True, slots=True)
class Check:
    """Holds one figure of a verification with its limit. ``value`` and ``passed`` are None if captures and reference do
    not allow the figure to be computed."""

    name: str
    value: float | None
    limit: float
    passed: bool | None  # None: not judged


def checks(limits: Limits, values: Mapping[str, float | None]) -> tuple[Check, ...]:
    """Returns one check for each limit; ``values`` are the figures by the names of the limits."""
    found = []
    for field in fields(limits):
        limit, value = getattr(limits, field.name), values[field.name]
        passed = None if value is None else value >= limit if field.name.startswith("least") else value <= limit
        found.append(Check(field.name, value, limit, passed))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Holds the scatter of each vertex over several captures of one subject: standard deviations (mm) from the mean
    head.

    ``position_mm`` is over all three directions together, ``normal_mm`` along the mean head's normal. The mean head has
    the pose of the first head.
    """

    mean: Float[np.ndarray, "v 3"]
    position_mm: Float[np.ndarray, " v"]
    normal_mm: Float[np.ndarray, " v"]

    def figures(
        self, stated_mm: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"], kept: Bool[np.ndarray, " v"]
    ) -> dict[str, float]:
        """Returns statistics of the ``kept`` vertices, weighted by ``weights``: the RMS scatter and the RMS standard
        deviation that the results state (mm, along the normal).

        ``scatter_over_stated`` is their ratio: 1 if all stated deviation is scatter, less if a part of it repeats
        in each capture. ``rank_correlation`` shows whether vertices with a larger stated deviation scatter more.
        """
        share = weights[kept] / weights[kept].sum()
        position, normal, stated = self.position_mm[kept], self.normal_mm[kept], stated_mm[kept]
        rms, along, said = (float(np.sqrt(share @ values**2)) for values in (position, normal, stated))
        varied = min(float(np.ptp(values)) for values in (normal, stated)) > 0
        return {
            "rms_mm": rms,
            "median_mm": float(np.median(position)),
            "p95_mm": float(np.percentile(position, 95)),
            "normal_rms_mm": along,
            "normal_median_mm": float(np.median(normal)),
            "stated_mm": said,
            "stated_median_mm": float(np.median(stated)),
            "scatter_over_stated": along / said if said else 0.0,
            "rank_correlation": float(np.corrcoef(rankdata(normal), rankdata(stated))[0, 1]) if varied else 0.0,
        }


@dataclass(frozen=True, slots=True)
class RegionError:
    """Holds statistics of the deviations (mm) in a region of the head, weighted by area. ``covered`` is the fraction of
    the region's area that the reference scan contains."""

    covered: float
    mean_mm: float
    rms_mm: float
    median_mm: float  # of the distances, as ``p95_mm``
    p95_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Holds the judgement of one capture. ``deviation_mm`` is the signed distance of each vertex from the reference,
    NaN where the vertex has no match."""

    name: str
    fit: BestFit
    deviation_mm: Float[np.ndarray, " v"]
    regions: Mapping[str, RegionError]
    probing_form_mm: float
    distances_mm: Mapping[str, tuple[float, float]]  # measured, and of the reference
    warnings: tuple[str, ...]

    @property
    def size_error_percent(self) -> float:
        """Returns by how many percent the head is larger than the reference; negative if it is smaller."""
        return 100.0 * (self.fit.scale - 1.0)

    @property
    def distance_rms_mm(self) -> float | None:
        """Returns the RMS error (mm) of the distances between landmarks; None if there are no common landmarks."""
        off = [measured - true for measured, true in self.distances_mm.values()]
        return float(np.sqrt(np.mean(np.square(off)))) if off else None


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Holds the judgement of all captures together.

    ``repeated_mm`` is the mean deviation over the captures at each vertex, ``repeated`` its errors by region.
    ``repeatability`` has the figures of ``Scatter`` by region; it is empty for a single capture.
    """

    captures: tuple[Judged, ...]
    repeated_mm: Float[np.ndarray, " v"]
    repeated: Mapping[str, RegionError]
    repeatability: Mapping[str, Mapping[str, float]]
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Returns whether all figures are within their limits. Figures that could not be computed (no landmarks, a
        single capture) are ignored."""
        return all(check.passed is not False for check in self.checks)


def judge(measured: Sequence[Measured], reference: Reference, limits: Limits) -> Judgement:
    """Judges heads of one subject against a reference scan. Raises InputError if the scan shows another subject."""
    captures = tuple(judge_one(one, reference) for one in measured)
    first = measured[0]
    deviations = np.stack([one.deviation_mm for one in captures])
    known = np.isfinite(deviations).all(axis=0)
    repeated_mm = np.where(known, np.where(known, deviations, 0.0).mean(axis=0), np.nan)
    repeatability: dict[str, dict[str, float]] = {}
    if len(measured) > 1:
        heads = np.stack([one.mesh_world.vertices for one in measured])
        found = scatter(heads, first.mesh_world.faces, first.regions["face"])
        stated = np.sqrt(np.mean([one.stated_mm**2 for one in measured], axis=0))
        named = {name: first.regions[name] for name in REGIONS if first.regions[name].any()}
        repeatability = {name: found.figures(stated, first.areas, kept) for name, kept in named.items()}
    values = _values(captures, repeatability)
    repeated = region_errors(repeated_mm, first)
    return Judgement(captures, repeated_mm, repeated, repeatability, checks(limits, values))


def judge_one(measured: Measured, reference: Reference) -> Judged:
    """Judges one head against the reference scan. Raises InputError if the reference shows another head, or if its
    faces point inwards."""
    fit = align_face(measured, reference)
    there = fit.reference_from_world.apply(measured.mesh_world.vertices)
    hits = reference.index.closest(there)
    side = np.einsum("nc,nc->n", there - hits.points, hits.normals)
    deviation = np.where(counted(hits, reference), np.copysign(hits.distances, side), np.nan)
    face = measured.regions["face"] & np.isfinite(deviation)
    turned = measured.mesh_world.normals() @ fit.reference_from_world.rotation.T
    facing = np.average(np.einsum("nc,nc->n", turned, hits.normals)[face] > 0, weights=measured.areas[face])
    if facing < MIN_FACING:
        raise InputError(reference.name, ["faces inwards: turn its triangles over, or mirror it back"])
    regions = region_errors(deviation, measured)
    form = weighted_range(deviation[face], measured.areas[face], FORM_SHARE)
    return Judged(measured.name, fit, deviation, regions, form, distance_pairs(measured, reference), measured.warnings)


def region_errors(deviation_mm: Float[np.ndarray, " v"], measured: Measured) -> dict[str, RegionError]:
    """Returns the errors in every region with at least the fraction ``MIN_COVERED`` of its area in the reference."""
    found = {}
    known = np.isfinite(deviation_mm)
    for name in REGIONS:
        region = measured.regions[name]
        whole, kept = float(measured.areas[region].sum()), region & known
        covered = float(measured.areas[kept].sum()) / whole if whole else 0.0
        if covered >= MIN_COVERED:
            found[name] = _region_error(deviation_mm[kept], measured.areas[kept], covered)
    return found


def _region_error(deviation_mm: Float[np.ndarray, " n"], areas: Float[np.ndarray, " n"], covered: float) -> RegionError:
    distance = np.abs(deviation_mm)
    return RegionError(
        covered,
        float(np.average(deviation_mm, weights=areas)),
        float(np.sqrt(np.average(distance**2, weights=areas))),
        *weighted_quantiles(distance, areas, (0.5, 0.95)),
    )


def weighted_range(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], share: float) -> float:
    """Returns the width of the central range that contains the fraction ``share`` of the weight; half of the remaining
    weight is cut off on each side."""
    low, high = weighted_quantiles(values, weights, (0.5 - share / 2, 0.5 + share / 2))
    return high - low


def weighted_quantiles(
    values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], shares: Sequence[float]
) -> list[float]:
    """Returns, for each of ``shares`` (0 to 1), the value below which this fraction of weight lies, interpolated."""
    order = np.argsort(values)
    reached = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    return np.interp(shares, reached, values[order]).tolist()


def distance_pairs(measured: Measured, reference: Reference) -> dict[str, tuple[float, float]]:
    """Returns each anthropometric distance (mm) whose landmarks exist on head and reference, as a pair: on the head,
    and on the reference."""
    found = {}
    for name, (one, other) in DISTANCES.items():
        if all(mark in marks for mark in (one, other) for marks in (measured.landmarks, reference.landmarks)):
            lengths = [
                float(np.linalg.norm(marks[other] - marks[one])) for marks in (measured.landmarks, reference.landmarks)
            ]
            found[name] = (lengths[0], lengths[1])
    return found


def _values(captures: Sequence[Judged], repeatability: Mapping[str, Mapping[str, float]]) -> dict[str, float | None]:
    """Returns the figures of the worst capture, by the names of the limits."""
    faces = [one.regions.get("face") for one in captures]
    features = [one.regions[name].rms_mm for one in captures for name in FEATURES if name in one.regions]
    distances = [rms for one in captures if (rms := one.distance_rms_mm) is not None]
    return {
        "face_rms_mm": max((face.rms_mm for face in faces if face), default=None),
        "features_rms_mm": max(features, default=None),
        "probing_form_mm": max(one.probing_form_mm for one in captures),
        "size_error_percent": max(abs(one.size_error_percent) for one in captures),
        "distance_mm": max(distances, default=None),
        "repeatability_mm": repeatability["face"]["normal_rms_mm"] if repeatability else None,
        "least_covered": min(face.covered if face else 0.0 for face in faces),
    }


def scatter(
    heads: Float[np.ndarray, "n v 3"], faces: Int[np.ndarray, "f 3"], laid_on: Bool[np.ndarray, " v"]
) -> Scatter:
    """Computes the scatter of two or more heads with corresponding vertices (mm, each head in any frame). The heads are
    first aligned with each other over the vertices ``laid_on``."""
    if len(heads) < 2:
        raise ValueError(f"{len(heads)} heads have no scatter; two are needed")
    mean = heads[0]
    placed = heads
    for _ in range(ROUNDS):
        placed = np.stack([rigid_fit(head[laid_on], mean[laid_on]).apply(head) for head in heads])
        before, mean = mean, placed.mean(axis=0)
        mean = rigid_fit(mean[laid_on], heads[0][laid_on]).apply(mean)  # or the mean would wander with each round
        if np.abs(mean - before).max() < STILL_MM:
            break
    placed = np.stack([rigid_fit(head[laid_on], mean[laid_on]).apply(head) for head in heads])
    off = placed - placed.mean(axis=0)
    along = np.einsum("nvc,vc->nv", off, vertex_normals(mean, faces))
    free = len(heads) - 1
    return Scatter(mean, np.sqrt((off**2).sum(axis=(0, 2)) / free), np.sqrt((along**2).sum(axis=0) / free))
