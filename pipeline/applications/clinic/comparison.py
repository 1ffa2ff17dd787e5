"""Compares two visits of one person: where the head changed by more than both results are sure of.

The later head is aligned rigidly to the earlier one on the forehead and the bridge of the nose, which neither
expression nor jaw move. Then each vertex of the earlier head has its signed distance (mm) to the later surface:
positive where that lies outside. A change counts where it exceeds ``SURE`` times the combined standard deviation: that
of both surfaces there and of the alignment, as independent errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.clinic.trimmed_fit import Patch, TrimmedFit, trimmed_fit
from pipeline.applications.clinic.visit import Visit
from pipeline.applications.verification.judgement import weighted_quantiles
from pipeline.applications.verification.reference import Reference
from pipeline.evidence.measurements import Measurement
from pipeline.head_model.landmarks import stacked
from rig.errors import InputError
from rig.geometry import RigidTransform, rigid_fit
from rig.messages.message import Message, compose

SURE = 2.0  # combined standard deviations
SHARE = 0.8  # of the stable region that must agree: the rest may be hair or a scar
FAR_MM = 25.0  # beyond it there is no counterpart
FACING = 0.3  # cosine between the normals of counterparts
START_NAMES = (
    "glabella",
    "nasion",
    *(
        f"{name}_{side}"
        for name in ("exocanthion", "endocanthion", "frontotemporale", "tragion")
        for side in ("right", "left")
    ),
)
MIN_MARKS = 3
MAX_STABLE_CHANGED = 0.05  # share of what no growth moves: two deviations leave as much to chance
NOT_THIS_MM = 1.5  # scatter on bone: one person has 0.02 to 0.3 mm, others 0.8 to 2.7; hair may be in the way


@dataclass(frozen=True, slots=True)
class RegionChange:
    """Holds the change (mm) of a region, by area. ``changed_share`` is the share of the area that changed for sure,
    ``volume_ml`` what lies between the surfaces there: positive where it grew."""

    mean_mm: float
    median_mm: float  # of the distances, as ``p95_mm``
    p95_mm: float
    largest_mm: float  # of what changed for sure, with its sign; 0 where nothing did
    changed_share: float
    volume_ml: float


@dataclass(frozen=True, slots=True)
class LengthChange:
    """Holds a measurement of both visits, and the later less the earlier one with its standard deviation (mm; None
    where a result has none)."""

    earlier: Measurement
    later: Measurement
    change_mm: float
    std_mm: float | None

    @property
    def is_sure(self) -> bool:
        """Tells whether it changed by more than ``SURE`` standard deviations."""
        return self.std_mm is not None and abs(self.change_mm) > SURE * self.std_mm


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Holds what two visits differ in. Rows are vertices of the earlier head; ``distance_mm`` is NaN where the later
    one has no counterpart."""

    earlier: Visit
    later: Visit
    fit: TrimmedFit  # later_from_earlier, of the stable region
    distance_mm: Float[np.ndarray, " v"]
    std_mm: Float[np.ndarray, " v"]
    regions: Mapping[str, RegionChange]
    lengths: Mapping[str, LengthChange]

    @property
    def changed(self) -> Bool[np.ndarray, " v"]:
        """Tells where the surface changed for sure."""
        return np.abs(np.nan_to_num(self.distance_mm)) > SURE * self.std_mm

    @property
    def sure_mm(self) -> Float[np.ndarray, " v"]:
        """Returns the distances with NaN where no change is sure."""
        return np.where(self.changed, self.distance_mm, np.nan)

    @property
    def warnings(self) -> tuple[Message, ...]:
        """Returns what makes the comparison doubtful: either head, and forehead and bridge of the nose that differ for
        sure."""
        share, doubts = self.regions["stable"].changed_share, (*self.earlier.warnings, *self.later.warnings)
        return (*doubts, compose("maybe-other-person", share=share)) if share > MAX_STABLE_CHANGED else doubts


def compare(earlier: Visit, later: Visit) -> Comparison:
    """Compares two visits. Raises InputError if the later result is no head of the same person."""
    head, surface = earlier.measured, Reference.of(later.measured.mesh_world, {}, later.measured.name)
    normals = head.mesh_world.normals()
    stable = earlier.stable & (earlier.views > 0)
    patch = Patch(head.mesh_world.vertices[stable], normals[stable], head.areas[stable])
    fit = trimmed_fit(patch, surface.index, _start(earlier, later), share=SHARE, beside=surface.beside)
    if fit is None or fit.std_mm > NOT_THIS_MM:
        off = float("inf") if fit is None else fit.std_mm
        other = compose("not-same-person", earlier=head.name, off_mm=off)
        raise InputError(later.measured.name, [other, *earlier.warnings, *later.warnings])
    there, facing = fit.motion.apply(head.mesh_world.vertices), normals @ fit.motion.rotation.T
    hits = surface.index.closest(there, facing=facing)
    known = (hits.distances < FAR_MM) & ~surface.beside(hits) & (np.einsum("nx,nx->n", facing, hits.normals) > FACING)
    side = np.einsum("nx,nx->n", hits.points - there, facing)
    distance = np.where(known, np.copysign(hits.distances, side), np.nan)
    later_std = np.einsum(
        "nk,nk->n", later.measured.stated_mm[later.measured.mesh_world.faces[hits.triangles]], hits.weights
    )
    std = np.sqrt(head.stated_mm**2 + later_std**2 + fit.std_along(there, facing) ** 2)
    changed = np.abs(np.nan_to_num(distance)) > SURE * std
    regions = _regions(earlier, distance, changed)
    return Comparison(earlier, later, fit, distance, std, regions, length_changes(earlier, later))


def length_changes(earlier: Visit, later: Visit) -> dict[str, LengthChange]:
    """Returns the change of every measurement that both results have."""
    found = {}
    for name, before in earlier.measurements.items():
        after = later.measurements.get(name)
        if after is None:
            continue
        std = None
        if before.std_mm is not None and after.std_mm is not None:
            std = float(np.hypot(before.std_mm, after.std_mm))
        found[name] = LengthChange(before, after, after.value_mm - before.value_mm, std)
    return found


def _start(earlier: Visit, later: Visit) -> RigidTransform:
    """Returns later_from_earlier by the landmarks that both have, else by the two head frames."""
    marks = earlier.measured.landmarks, later.measured.landmarks
    names = [name for name in START_NAMES if all(name in of for of in marks)]
    if len(names) < MIN_MARKS:
        return later.measured.head_from_world.inverse() @ earlier.measured.head_from_world
    return rigid_fit(stacked(marks[0], names), stacked(marks[1], names))


def _regions(
    earlier: Visit, distance: Float[np.ndarray, " v"], changed: Bool[np.ndarray, " v"]
) -> dict[str, RegionChange]:
    found, known = {}, np.isfinite(distance)
    masks = {"whole": np.ones(len(distance), bool), "stable": earlier.stable, **earlier.measured.regions}
    for name, mask in masks.items():
        rows = mask & known
        if not rows.any():
            continue
        values, areas, sure = distance[rows], earlier.measured.areas[rows], changed[rows]
        largest = values[sure][np.argmax(np.abs(values[sure]))] if sure.any() else 0.0
        median, p95 = weighted_quantiles(np.abs(values), areas, (0.5, 0.95))
        found[name] = RegionChange(
            float(np.average(values, weights=areas)),
            median,
            p95,
            float(largest),
            float(areas[sure].sum() / areas.sum()),
            float((values * areas)[sure].sum() / 1000.0),
        )
    return found
