"""Computes one silhouette for each camera of a capture by background subtraction (the paper's section 5.4).

First ``pipeline.segmentation.foreground`` decides which pixels show the subject; other cameras decide about doubtful
pixels. After this decision ``pipeline.segmentation.matting`` finds the sub-pixel contour. As the last step the
silhouettes of all cameras are compared. ``quality.usable`` is False if a mask would harm a fit, and
``quality.warnings`` give the reason. Masks that the operator supplies replace the computed masks.

A coarse visual hull (the paper's figure 1) shows whether the silhouettes agree. A voxel is empty according to a camera
that sees it clearly outside its silhouette. A view can be wrong in two ways. *Strange* area is mask where, according to
at least two other cameras, every voxel on the ray is empty: a moved chair, a passer-by. *Missing* area is background in
this view, although no other camera excludes the voxels on the ray: hair or a coat in the colour of the backdrop. Two
cameras must agree that a voxel is empty, so that one bad view does not affect the others.

A visual hull is larger than the subject, most of all with few cameras: the hull of three cameras covers up to 11 % more
than a correct fourth mask. Missing area therefore counts only if the view also *contradicts* another camera: this view
alone excludes all voxels behind a part of the other camera's mask. Correct masks never contradict each other, however
few they are.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, UInt8

from pipeline.compute.threads import map_in_threads, task_pool
from pipeline.compute.trace import traced
from pipeline.geometry.projection import packed_camera
from pipeline.imaging.masks import dilate, distance_to_level, erode
from pipeline.imaging.silhouette import Silhouette, ViewQuality, silhouette_from_mask
from pipeline.multiview.visual_hull import depth_of, hull_extent, mask_extent
from pipeline.segmentation.background import Background
from pipeline.segmentation.foreground import Decision, decide, doubtful, reconsider
from pipeline.segmentation.mask_kernels import MIN_WITNESSES, least_dissent
from pipeline.segmentation.matting import ALPHA_BLUR_PX, WEAK_CONTRAST, Matte, solve_matte
from pipeline.segmentation.without_plates.head_seed import HeadSeed, above_chin, find_head_seed
from rig.camera import Camera
from rig.capture import Capture
from rig.errors import InputError
from rig.image import ImageRgb, plates_for
from rig.messages.message import Message, compose
from rig.progress import Progress
from rig.rig import Rig

MIN_SUBJECT_SHARE = 0.01  # of the image; a smaller subject is none
MAX_PIECES_SHARE = 0.01  # of the subject: foreground that is not connected to it, from which a view is warned of ...
MAX_PIECES_SHARE_USABLE = 0.15  # ... and from which it is unusable
MAX_WEAK_SHARE = 0.015  # of the contour; 0.003 in 95 % of 66 good views
MAX_WEAK_SHARE_USABLE = 0.25  # of the contour
STRANGER_SHARE = 3e-4  # of the subject: smaller pieces are noise, and smaller holes: whites of eyes before a grey wall
SOLID_HOLE = 0.995  # mean coarse probability: 1.000 in false holes of noisy captures, at most 0.99 in gaps of hair
UNDECIDED = 0.3  # from one half: share of a cut's windows that is neither yes nor no
UNDECIDED_PX = 15  # side of a window ...
UNDECIDED_FILLED = 0.6  # ... and its part that is undecided where the outline is a guess
NOISE_HOLE = 12  # pixels: a hole of this size in alpha is noise, however small the subject
SEEDED_VIEWS = 8  # fewer do not tell the subject by each other, and begin with its face
ENOUGH_USABLE = 0.7  # of the views: 1 of 11 where skin and wall are alike, all of them in scan-a and draw-b, which a
# face as the beginning makes no better
BODY_FILLS = 0.75  # of the subject's width is on the border where shoulders leave; a cut above the brow leaves less
MIN_GAIN, MAX_GAIN = 0.5, 2.0  # one stop of exposure between plate and shot; beyond that it is another scene
MAX_STRANGE_SHARE = 0.003  # of the mask: area that the other cameras call empty; 0 in 22 good views
MAX_STRANGE_SHARE_USABLE = 0.01  # of the mask
MAX_MISSING_SHARE = 0.005  # of the mask: area deep inside all the others; 0 in 22 good views
MAX_MISSING_SHARE_USABLE = 0.02  # of the mask
GRID = 32  # voxels a side: 12 mm on a subject of 400 mm
REDUCTION = 16  # of the image in which areas are counted
MIN_CAMERAS = 4  # with fewer, one camera's word stands against another's
MIN_CONTRADICTED = 1e-3  # of the others' masks, mean: 0 in 150 true views of 4 to 24 cameras; 0.0013 and more where a
# crown is missing, and up to 0.0016 then in a good view beside it ...
MAX_CONTRADICTED = 0.5  # ... which contradicts less than this share of what the worst view does


def segment(capture: Capture, rig: Rig, *, report: Progress) -> dict[str, Silhouette]:
    """Returns the silhouette of every camera of the rig. A capture without any plate or mask is segmented from the
    photographs alone. Raises InputError if some cameras have a plate or mask and others have none."""
    if not capture.backgrounds and not capture.masks:
        return _without_plates(capture, rig, report)
    blind = [name for name in rig.names if name not in capture.masks and not capture.backgrounds.get(name)]
    if blind:
        raise InputError("capture", [compose("neither-plate-nor-mask", camera=name) for name in blind])
    silhouettes: dict[str, Silhouette] = {}
    with task_pool() as pool:  # cv2 and the compiled kernels release the interpreter lock
        from_masks = {
            name: pool.submit(_operators, capture.masks[name], capture.soft_masks.get(name))
            for name in rig.names & capture.masks.keys()
        }
        jobs = {
            name: pool.submit(_decided, capture.images[name], capture.backgrounds[name])
            for name in rig.names
            if name not in from_masks
        }
        decisions = {name: job.result() for name, job in jobs.items()}
        masks = {name: decision.mask for name, decision in decisions.items()}
        masks |= {name: job.result().mask for name, job in from_masks.items()}

        def finish(name: str) -> Silhouette:
            decision = decisions[name]
            doubt = doubtful(decision)
            if doubt.any():
                decision = reconsider(decision, count_rejecting_cameras(doubt, name, masks, rig))
            return _refined(capture.images[name], decision)

        finished = {name: pool.submit(finish, name) for name in decisions}
        for count, name in enumerate(rig.names, 1):
            silhouettes[name] = (from_masks | finished)[name].result()
            report("segmentation", 0.4 + 0.5 * count / len(rig))
    agreed = judge_agreement(silhouettes, rig, ready=capture.masks.keys())
    report("segmentation", 1.0)
    return agreed


def _without_plates(capture: Capture, rig: Rig, report: Progress) -> dict[str, Silhouette]:
    """Finds the silhouettes without plates or masks. With few views the search starts at the subject's face. With more
    views the search starts at the face only if a search without a face finds too few usable silhouettes."""
    few = len(rig) < SEEDED_VIEWS
    found = _searched(capture, rig, find_head_seed(capture.images, rig) if few else None, report)
    if not few and _usable_count(found) < ENOUGH_USABLE * len(rig):
        head = find_head_seed(capture.images, rig)
        seeded = found if head is None else _searched(capture, rig, head, report)
        found = max(found, seeded, key=_usable_count)
    report("segmentation", 1.0)
    return found


def _usable_count(silhouettes: Mapping[str, Silhouette]) -> int:
    return sum(silhouette.quality.usable for silhouette in silhouettes.values())


def _searched(capture: Capture, rig: Rig, head: HeadSeed | None, report: Progress) -> dict[str, Silhouette]:
    """Searches the silhouettes from a start at ``head`` or, if None, at the point to which all cameras are directed."""
    from pipeline.segmentation.without_plates.decide import decide_without_plates  # packages that few captures need

    found = decide_without_plates(
        capture.images, rig, head=head, report=lambda share: report("segmentation", 0.8 * share)
    )
    with task_pool() as pool:
        counted = {
            n: None if head is None else above_chin(head, rig[n], capture.images[n].shape[:2]) for n in rig.names
        }  # what is guessed on clothes does not count against the head
        jobs = {n: pool.submit(_refined, capture.images[n], one, counted[n]) for n, one in found.decisions.items()}
        jobs |= {n: pool.submit(_as_cut, share, counted[n]) for n, share in found.shares.items()}
        silhouettes = {name: _doubted(jobs[name].result()) for name in rig.names}
    return judge_agreement(silhouettes, rig)


def _doubted(silhouette: Silhouette) -> Silhouette:
    """Replaces a silhouette's warning about a weak outline by the message for captures without plates, since its advice
    differs."""
    quality, weak = silhouette.quality, float(np.asarray(silhouette.quality.figures.get("weak_share", 1.0)))
    if weak <= MAX_WEAK_SHARE:
        return silhouette
    text = compose("outline-guessed", share=weak)
    kept = tuple(warning for warning in quality.warnings if not _concerns(warning, "outline-weak"))
    if weak > MAX_WEAK_SHARE_USABLE:
        return silhouette.judged(warnings=(*kept, compose("view-unused", remark=text)))
    return silhouette.judged(warnings=kept, doubts=(text,))


def _concerns(message: Message, code: str) -> bool:
    """Returns True if a message, or a remark in it, has the given code."""
    remark = message.parameters.get("remark")
    return message.code == code or (isinstance(remark, Message) and remark.code == code)


def _as_cut(share: Float32[np.ndarray, "h w"], counted: Bool[np.ndarray, "h w"] | None = None) -> Silhouette:
    """Returns the silhouette of a view whose mask was cut along image edges. The outline is doubtful where overlapping
    windows, each cut alone, disagree. Only the outline of the pixels ``counted`` is judged; None means all pixels."""
    alpha, holes = _without_specks(share, np.zeros_like(share))
    mask = alpha > 0.5
    undecided = dilate(np.abs(share - 0.5) < UNDECIDED, 1)
    rim = mask & ~erode(mask, 1)
    rim = rim if counted is None else rim & counted
    broad = cv2.blur(undecided.astype(np.float32), (UNDECIDED_PX, UNDECIDED_PX)) > UNDECIDED_FILLED
    weak = float(broad[rim].mean()) if rim.any() else 1.0
    figures = {"cut": 1.0, "weak_share": round(weak, 4)}
    return Silhouette(mask, distance_to_level(alpha), _quality(mask, (1, holes), float("inf"), weak, figures))


def _operators(mask: Bool[np.ndarray, "h w"], share: UInt8[np.ndarray, "h w"] | None) -> Silhouette:
    """Returns the silhouette of a mask that the operator supplied. If the mask has soft edges (``share``), the outline
    is where ``share`` is one half."""
    if share is None:
        return replace(silhouette_from_mask(mask), quality=_mask_quality(mask))
    smooth = cv2.GaussianBlur(share * np.float32(1 / 255), (0, 0), ALPHA_BLUR_PX)
    return Silhouette(mask, distance_to_level(smooth), _mask_quality(mask))


def _decided(image: ImageRgb, plates: tuple[ImageRgb, ...]) -> Decision:
    return decide(image, plates_for(image, plates))


def _refined(image: ImageRgb, decision: Decision, counted: Bool[np.ndarray, "h w"] | None = None) -> Silhouette:
    """Returns the sub-pixel silhouette of a coarse decision, or an unusable silhouette if the mask is too small. Only
    the outline of the pixels ``counted`` is judged; None means all pixels."""
    if decision.mask.mean() < MIN_SUBJECT_SHARE:
        return _nothing(image.shape[:2], decision.background)
    matte = solve_matte(image, decision)
    return _silhouette(matte, decision, counted)


def _silhouette(matte: Matte, decision: Decision, counted: Bool[np.ndarray, "h w"] | None) -> Silhouette:
    alpha = np.zeros(decision.background.plates.shape[1:3], np.float32)
    coarse = cv2.resize(decision.probability.astype(np.float32), alpha.shape[::-1], interpolation=cv2.INTER_LINEAR)
    alpha[matte.box], holes = _without_specks(matte.alpha, coarse[matte.box])
    distance = distance_to_level(alpha)
    little = matte.contrast < WEAK_CONTRAST
    if counted is not None:
        rim = matte.alpha > 0.5
        little = little[counted[matte.box][rim & ~erode(rim, 1)]]
    weak = float(little.mean()) if len(little) else 1.0
    if counted is None:
        # What lies beside the unsolved is right in four of five places: reason to warn, not to leave the view out.
        weak = max(weak, min(matte.unsure, MAX_WEAK_SHARE_USABLE))
    contrast = float(np.median(matte.contrast)) if len(matte.contrast) else 0.0
    others = sum(a for a in decision.detached_component_areas if a > STRANGER_SHARE)
    background = decision.background
    figures = {
        "gain": [round(float(g), 4) for g in background.gain],
        "noise_levels": round(float(np.median(background.noise)), 3),
        "background_share": round(float(background.inliers.mean()), 4),
        "weak_share": round(weak, 4),
        "other_pieces": round(others, 4),
    }
    mask = alpha > 0.5
    return Silhouette(mask, distance, _quality(mask, (1, holes), contrast, weak, figures))


def _without_specks(
    alpha: Float32[np.ndarray, "h w"], coarse: Float32[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w"], int]:
    """Keeps only the subject's connected component in alpha, and fills holes from noise. Returns alpha and the number
    of remaining holes.

    A small hole counts as noise. A larger hole counts as noise if the ``coarse`` probability, in which the sensor's
    noise is averaged, is high in the whole hole. Holes from noise occur if skin has the colour of the backdrop.
    """
    mask = alpha > 0.5
    labels, areas = _labelled(mask, 4)
    if len(areas) > 2:
        main = int(np.argmax(areas[1:])) + 1
        alpha = np.where(mask & (labels != main), np.float32(0.49), alpha)
    labels, areas = _labelled(alpha <= 0.5, 8)
    solid = np.bincount(labels.ravel(), coarse.ravel(), len(areas)) > SOLID_HOLE * areas
    small = solid | (areas < max(NOISE_HOLE, STRANGER_SHARE * np.count_nonzero(mask)))
    small[0] = False
    if small.any():
        alpha = np.where(small[labels], np.float32(0.51), alpha)
    enclosed = ~np.isin(np.arange(len(areas)), np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    enclosed[0] = False
    return alpha, int((enclosed & ~small).sum())


def _labelled(mask: Bool[np.ndarray, "h w"], connectivity: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the label of each pixel's component, 0 where the mask is False, and the area of each component."""
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.view(np.uint8), connectivity, cv2.CV_16U, cv2.CCL_SPAGHETTI
    )
    return labels, stats[:, cv2.CC_STAT_AREA].copy()


def _mask_quality(mask: Bool[np.ndarray, "h w"]) -> ViewQuality:
    """Returns the quality of a mask that the operator supplied."""
    components = len(_labelled(mask, 8)[1]) - 1
    holes = len(_labelled(np.pad(~mask, 1, constant_values=True), 4)[1]) - 2
    return _quality(mask, (components, holes), float("inf"), 0.0, {})


def _quality(
    mask: Bool[np.ndarray, "h w"], components_holes: tuple[int, int], contrast: float, weak: float, figures: dict
) -> ViewQuality:
    """Judges a single mask: which image borders cut it off, its contrast and area, and the resulting warnings."""
    borders = {"left": mask[:, 0], "right": mask[:, -1], "top": mask[0], "bottom": mask[-1]}
    cut_off = tuple(name for name, line in borders.items() if line.sum() > 2)
    warnings, fatal = [], []
    crown = _crown_side(mask)
    if crown in cut_off:
        code = "head-cut-off-at-top" if crown == "top" else "head-cut-off-at-side"
        warnings.append(compose(code, side=crown))
    apart = figures.get("other_pieces", 0.0)
    if apart > MAX_PIECES_SHARE:
        text = compose("pieces-apart", share=apart)
        (fatal if apart > MAX_PIECES_SHARE_USABLE else warnings).append(text)
    if weak > MAX_WEAK_SHARE:
        text = compose("outline-weak", share=weak)
        (fatal if weak > MAX_WEAK_SHARE_USABLE else warnings).append(text)
    share = np.count_nonzero(mask) / mask.size
    if share < MIN_SUBJECT_SHARE or share > 0.95:
        fatal.append(compose("subject-area-absurd", share=share))
    gains = figures.get("gain", [1.0])
    if not all(MIN_GAIN < g < MAX_GAIN for g in gains):
        fatal.append(compose("light-changed", factor=max(gains)))
    warnings += [compose("view-unused", remark=text) for text in fatal]
    components, holes = components_holes
    return ViewQuality(not fatal, contrast, cut_off, components, holes, tuple(warnings), figures)


def _crown_side(mask: Bool[np.ndarray, "h w"]) -> str:
    """Returns the image border next to the crown. The crown's border is opposite the border through which the body
    leaves the picture and which the body nearly fills. Cameras may be mounted on their side."""
    across, down = mask.sum(axis=0), mask.sum(axis=1)
    widest = {"top": down.max(), "bottom": down.max(), "left": across.max(), "right": across.max()}
    touched = {"top": mask[0].sum(), "bottom": mask[-1].sum(), "left": mask[:, 0].sum(), "right": mask[:, -1].sum()}
    body = max(touched, key=lambda side: touched[side])
    return _OPPOSITE[body] if touched[body] >= BODY_FILLS * max(widest[body], 1) else "top"


_OPPOSITE = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}


def _nothing(shape: tuple[int, ...], background: Background) -> Silhouette:
    mask = np.zeros(shape, bool)
    text = compose("no-subject-stands-out")
    figures = {"background_share": float(background.inliers.mean())}
    far = np.full(shape, float(sum(shape)), np.float32)  # no contour: farther than any pixel
    return Silhouette(mask, far, ViewQuality(False, 0.0, (), 0, 0, (text,), figures))


def count_rejecting_cameras(
    doubt: Bool[np.ndarray, "h w"], name: str, masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig
) -> Int8[np.ndarray, "h w"]:
    """Counts, for each doubtful pixel of camera ``name``, the other cameras that see no subject anywhere on its ray (at
    most ``MAX_DISSENT``). The value is -1 for pixels that are not doubtful, or that too few cameras see. Masks may be
    smaller than the images, all by the same factor."""
    out = np.full(doubt.shape, -1, np.int8)
    others = [camera for camera in rig if camera.name != name and masks[camera.name].any()]
    if len(others) < MIN_WITNESSES or not doubt.any():
        return out
    centre, edge = mask_extent({camera.name: masks[camera.name] for camera in others}, rig)
    rows, columns = np.nonzero(doubt)
    asking = rig[name]
    scale = asking.intrinsics.width / doubt.shape[1]
    rays = asking.rays_world((np.stack([columns, rows], axis=1) + 0.5) * scale - 0.5)
    distances, scales = _stacked([masks[camera.name] for camera in others], [c.intrinsics.width for c in others])
    parameters = np.array([packed_camera(camera) for camera in others])
    middle = float(np.linalg.norm(centre - asking.centre_world))
    span = (middle - 0.75 * edge, middle + 0.75 * edge)
    out[rows, columns] = least_dissent(asking.centre_world, rays, span, parameters, distances, scales)
    return out


def _stacked(masks: list[np.ndarray], widths: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns distance maps to each camera's mask (mask pixels; 0 inside, negative outside the image), and the width of
    a mask pixel in image pixels."""
    height, width = max(mask.shape[0] for mask in masks), max(mask.shape[1] for mask in masks)
    out = np.full((len(masks), height, width), -1.0, np.float32)
    for k, mask in enumerate(masks):
        away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        out[k, : mask.shape[0], : mask.shape[1]] = away
    return out, np.array([w / mask.shape[1] for w, mask in zip(widths, masks, strict=True)])


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Holds, for each camera and voxel, whether the camera sees the voxel and whether it lies outside its
    silhouette."""

    pixels: Float[np.ndarray, "k n 2"]
    radius_px: Float[np.ndarray, " k"]  # of a voxel in each camera
    seen: Bool[np.ndarray, "k n"]
    empty: Bool[np.ndarray, "k n"]
    depth: Float[np.ndarray, "k n"]  # distance outside the silhouette, px


def voxel_grid(centre: Float[np.ndarray, " 3"], edge: float, count: int) -> Float[np.ndarray, "n 3"]:
    """Returns the centres (world frame, mm) of the voxels of a cube, ``count`` along each side."""
    line = (np.arange(count) + 0.5) / count - 0.5
    return centre + edge * np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)


def cast_votes(silhouettes: Mapping[str, Silhouette], rig: Rig, count: int = GRID) -> Votes:
    """Projects the voxels of a coarse grid around the subject into every camera. Returns which voxels each camera sees,
    and which of them lie outside its silhouette."""
    centre, edge = hull_extent(silhouettes, rig)
    voxels = voxel_grid(centre, edge, count)

    def vote(camera: Camera) -> tuple:
        where = camera.project(voxels)
        k = camera.intrinsics
        radius = 0.87 * edge / count * k.fx / depth_of(camera, centre)  # half the diagonal of a voxel
        inside = np.logical_and(where >= 0, where <= (k.width - 1, k.height - 1)).all(axis=1)  # NaN is not
        at = np.rint(np.where(inside.reshape(-1, 1), where, 0.0)).astype(int)
        depth = np.where(inside, silhouettes[camera.name].distance[at[:, 1], at[:, 0]], -np.inf)
        return where, radius, inside, depth > radius, depth

    votes = map_in_threads(lambda k: vote(rig.cameras[k]), len(rig))
    return Votes(*(np.array(values) for values in zip(*votes, strict=True)))


@traced
def judge_agreement(
    silhouettes: Mapping[str, Silhouette], rig: Rig, *, ready: Collection[str] = ()
) -> dict[str, Silhouette]:
    """Compares each silhouette with the other cameras' silhouettes. Returns the silhouettes with the disagreement added
    to their quality.

    Args:
        silhouettes: by camera; unusable ones are ignored.
        rig: the cameras as calibrated.
        ready: cameras with a mask from the operator; they get warnings, but stay usable.
    """
    trusted = [name for name in rig.names if silhouettes[name].quality.usable]
    if len(trusted) < MIN_CAMERAS:
        return dict(silhouettes)
    believed = rig.subset(trusted)
    votes = cast_votes(silhouettes, believed)
    judged = dict(silhouettes)
    masks = [silhouettes[name].mask for name in trusted]
    shares = map_in_threads(lambda k: _shares(votes, k, masks[k]), len(trusted))
    suspects = [k for k, (_, missing) in enumerate(shares) if missing > MAX_MISSING_SHARE]
    found = map_in_threads(lambda i: _contradicted(votes, suspects[i], masks), len(suspects))
    contradicted = dict(zip(suspects, found, strict=True))
    limit = max(MIN_CONTRADICTED, MAX_CONTRADICTED * max(contradicted.values(), default=0.0))
    culprits = [k for k, share in contradicted.items() if share >= limit]
    for k, (name, (strange, missing)) in enumerate(zip(trusted, shares, strict=True)):
        if strange > MAX_STRANGE_SHARE and culprits:
            # What a view that lacks something calls empty speaks against nobody.
            heard = replace(votes, empty=votes.empty & ~np.isin(np.arange(len(trusted)), culprits)[:, None])
            strange, _ = _shares(heard, k, masks[k])
        missing = missing if k in culprits else 0.0
        judged[name] = _judged(silhouettes[name], strange, missing, ready=name in ready)
    return judged


def _shares(votes: Votes, k: int, mask: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    """Returns two areas of camera k as fractions of its mask: the part that other cameras exclude (strange), and the
    part that the mask lacks although no other camera excludes it (missing)."""
    small = _reduced(mask)
    size, area = small.shape[::-1], max(float(small.sum()), 1.0)
    others = np.delete(np.arange(len(votes.seen)), k)
    witnesses, against = votes.seen[others].sum(axis=0), votes.empty[others].sum(axis=0)
    known = votes.seen[k] & (witnesses >= 2)
    explained = _splat(votes, k, votes.seen[k] & (against <= _allowed(len(others))), size)
    strange = float(small[_splat(votes, k, known, size) & ~explained].sum()) / area
    # Well inside for all others: a hull's natural excess is slivers along their contours.
    solid = (~votes.seen[others] | (votes.depth[others] < -votes.radius_px[others, None])).all(axis=0)
    wanted = known & (witnesses >= 0.5 * len(others)) & solid & (votes.depth[k] > 2 * votes.radius_px[k])
    missing = float((_splat(votes, k, wanted, size, grow=False) & (small < 0.5)).sum()) / area
    return strange, missing


def _contradicted(votes: Votes, k: int, masks: Sequence[Bool[np.ndarray, "_ _"]]) -> float:
    """Returns the fraction of another camera's mask behind which camera k alone excludes all voxels, averaged over the
    other cameras."""
    shares = []
    for j in range(len(votes.seen)):
        others = np.delete(np.arange(len(votes.seen)), [j, k])
        if j == k or not len(others):
            continue
        small = _reduced(masks[j])
        size = small.shape[::-1]
        possible = votes.seen[j] & (votes.empty[others].sum(axis=0) <= _allowed(len(others)))
        witnessed = possible & votes.seen[k] & votes.seen[others].any(axis=0)
        explained = _splat(votes, j, possible & ~votes.empty[k], size)
        lost = _splat(votes, j, witnessed, size, grow=False) & ~explained
        shares.append(float(small[lost].sum()) / max(float(small.sum()), 1.0))
    return float(np.mean(shares)) if shares else 0.0


def _allowed(others: int) -> int:
    """Returns how many of the other cameras may wrongly exclude a voxel: 1 if there are five or more, else 0."""
    return 1 if others >= 5 else 0


def _reduced(mask: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "r c"]:
    size = (-(-mask.shape[1] // REDUCTION), -(-mask.shape[0] // REDUCTION))
    return cv2.resize(mask.view(np.uint8) * np.float32(1), size, interpolation=cv2.INTER_AREA)


def _splat(
    votes: Votes, k: int, chosen: Bool[np.ndarray, " n"], size: tuple[int, int], *, grow: bool = True
) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of camera k's reduced image that the chosen voxels cover."""
    drawn = np.zeros((size[1], size[0]), np.uint8)
    at = (votes.pixels[k][chosen] / REDUCTION).astype(int)
    drawn[np.clip(at[:, 1], 0, size[1] - 1), np.clip(at[:, 0], 0, size[0] - 1)] = 1
    reach = int(np.ceil(votes.radius_px[k] / REDUCTION)) if grow else 0
    return cv2.dilate(drawn, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)).view(bool)


def _judged(silhouette: Silhouette, strange: float, missing: float, *, ready: bool) -> Silhouette:
    quality = silhouette.quality
    warnings, usable = list(quality.warnings), quality.usable
    if strange > MAX_STRANGE_SHARE:
        bad = strange > MAX_STRANGE_SHARE_USABLE and not ready
        usable &= not bad
        text = compose("mask-alone-ready" if ready else "mask-alone", share=strange)
        warnings.append(compose("view-unused", remark=text) if bad else text)
    if missing > MAX_MISSING_SHARE:
        bad = missing > MAX_MISSING_SHARE_USABLE and not ready
        usable &= not bad
        text = compose("mask-incomplete-ready" if ready else "mask-incomplete", share=missing)
        warnings.append(compose("view-unused", remark=text) if bad else text)
    figures = {**quality.figures, "strange_share": round(strange, 4), "missing_share": round(missing, 4)}
    return silhouette.judged(usable=usable, warnings=tuple(warnings), figures=figures)
