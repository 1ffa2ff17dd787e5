"""Finds faces in one picture, with 468 points on each.

The picture may have any orientation. The detector proposes faces in the picture rotated by 0, 90, 180 and 270 degrees,
since it tolerates 45 degrees either way. A proposal is accepted if the landmark network confirms it in a crop around
the landmarks. The network runs on the crop and on its mirror image, and the two results are averaged. Crops are
squares, rotated so that the face is upright in them. Crops are sampled from an image pyramid at the level near their
resolution, to avoid aliasing."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.faces.networks import FINDER_SIZE, LANDMARK_SIZE, FaceNetworks
from pipeline.faces.points import CHIN, FOREHEAD, LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS, point_table
from rig.capture import ImageRgb

SMALLEST_PX = 192  # of the longer side: no network wants a smaller picture
AREA_FROM = 1.7  # pixels of the picture to one of the crop from which the next half is read: bilinear reads two
CROP_OF_FACE = 1.5  # side of a crop by the larger side of the points in it
MIN_ROUNDS, MAX_ROUNDS = 2, 8  # of a crop that follows its points: five where the first is turned by 40 degrees
SETTLED, SETTLED_DEG = 0.02, 2.0  # a step of a crop, by its side, and of its roll: the last that counts
MIN_PROPOSAL = -1.0  # the finder's score; faces to 65 degrees have 0.3 or more
MAX_PROPOSALS = 6
MIN_SCORE = 0.0  # the landmark network's; 30 pictures without a face, and hair from behind, have -2 at most
CERTAIN_SCORE = 15.0  # faces that are taken for upright and are not have 11 at most
SAME_FACE = 0.5  # of the size of a face: as near as the centres of two boxes of one may lie
SAME_WAY_UP_DEG = 60.0
MAX_CELLS = 200  # a face lights some thirty
RIGHT_EYE, LEFT_EYE = 2, 3  # rows of the finder's faces


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """Holds a square part of a picture: its centre and side (px of the picture), and the clockwise angle (degrees) of
    the square in the picture. A ``mirrored`` crop is read from right to left."""

    centre_px: Float[np.ndarray, " 2"]
    side_px: float
    roll_deg: float
    mirrored: bool = False

    def picture_from_crop(self, size: int) -> Float[np.ndarray, "2 3"]:
        """Returns the affine map (2 x 3) from pixels of this crop, sampled at ``size`` x ``size``, to pixels of the
        picture."""
        turn = np.deg2rad(self.roll_deg)
        scale = self.side_px / size
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if self.mirrored:
            linear[:, 0] *= -1.0
        middle = np.full(2, (size - 1) / 2)
        return np.column_stack([linear, self.centre_px - linear @ middle])


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Holds an image pyramid: a picture at full size, half size, quarter size and so on, the full size first."""

    levels: tuple[ImageRgb, ...]

    @property
    def size_px(self) -> Float[np.ndarray, " 2"]:
        """Returns the width and height of the full-size picture in pixels."""
        return np.array(self.levels[0].shape[1::-1], float)

    def sample(self, crop: Crop, size: int) -> UInt8[np.ndarray, "size size 3"]:
        """Returns the pixels of a crop, resampled to ``size`` x ``size``; pixels outside the picture are black."""
        picture_from_crop = crop.picture_from_crop(size)
        halvings = int(np.ceil(np.log2(max(crop.side_px / size / AREA_FROM, 1.0))))
        level = self.levels[min(halvings, len(self.levels) - 1)]
        ratio = np.array(level.shape[1::-1]) / self.size_px
        level_from_crop = ratio[:, None] * picture_from_crop
        level_from_crop[:, 2] += 0.5 * ratio - 0.5  # pixel centres: u' = (u + 1/2) ratio - 1/2
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(level, level_from_crop, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT)


def make_pyramid(image: ImageRgb) -> Pyramid:
    """Builds an image pyramid by halving a picture until its longer side is below twice ``SMALLEST_PX``."""
    levels = [np.ascontiguousarray(image)]
    while max(levels[-1].shape[:2]) >= 2 * SMALLEST_PX:
        height, width = levels[-1].shape[:2]
        half = ((width + 1) // 2, (height + 1) // 2)
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return Pyramid(tuple(levels))


def in_picture(
    points_crop: Float[np.ndarray, "n 2"], picture_from_crop: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "n 2"]:
    """Converts points of a crop to pixels of the picture."""
    return points_crop @ picture_from_crop[:, :2].T + picture_from_crop[:, 2]


@dataclass(frozen=True, slots=True, eq=False)
class FaceDetection:
    """Holds one face that was found in one picture.

    All positions are pixels of the picture as it was taken, lens distortion included; (0, 0) is the centre of the
    top-left pixel. ``landmarks_px`` are the 468 points of the face mesh. ``roll_deg`` is the clockwise angle of the
    face in the picture. ``irises_px`` holds five points of the subject's right eye, then five of the left one: the
    centre of the iris, then its edge towards the nose, above, away from the nose, and below. ``lids_px`` holds 16
    points on the edges of the right eye's lids, in the order of ``points.RIGHT_EYE_OUTLINE``, then 16 of the left.
    """

    landmarks_px: Float[np.ndarray, "468 2"]
    score: float  # of the landmark network: 15 to 55 on faces, below 0 elsewhere
    box_px: Float[np.ndarray, " 4"]  # left, top, right, bottom of the points
    roll_deg: float
    irises_px: Float[np.ndarray, "10 2"] | None = None  # None where nobody looked (``eyes.find_eyes``)
    lids_px: Float[np.ndarray, "32 2"] | None = None

    @property
    def size_px(self) -> float:
        """Returns the longer side (px) of the box around the 468 points; the box is rotated with the face."""
        return crop_around(self.landmarks_px).side_px / CROP_OF_FACE


def find_faces(image: ImageRgb, networks: FaceNetworks) -> tuple[FaceDetection, ...]:
    """Finds the faces in a picture, the best score first. Faces larger than an eighth of the picture's longer side are
    searched first. If no face of at least an eighth is found, faces down to a sixteenth of this side are searched."""
    pyramid = make_pyramid(image)
    return find_large_faces(pyramid, networks) or find_small_faces(pyramid, networks)


def find_large_faces(pyramid: Pyramid, networks: FaceNetworks) -> tuple[FaceDetection, ...]:
    """Finds the faces that are large enough to be detected in the whole picture. The search takes 0.03 s for an upright
    face, else 0.06 s."""
    return _find(pyramid, _whole(pyramid), networks)


def find_small_faces(pyramid: Pyramid, networks: FaceNetworks) -> tuple[FaceDetection, ...]:
    """Finds smaller faces in nine overlapping parts of the picture at twice the size. The search takes 0.35 s."""
    return _find(pyramid, _parts(pyramid), networks)


def find_face_at(
    pyramid: Pyramid, crop: Crop, networks: FaceNetworks, *, min_rounds: int = MIN_ROUNDS
) -> FaceDetection:
    """Places the 468 points on the face in a crop. The crop is centred on the points again until they no longer change.
    The score is high only if the crop shows a face."""
    for count in range(MAX_ROUNDS):
        points, _ = _place(pyramid, crop, networks)
        before, crop = crop, crop_around(points)
        if count + 1 >= min_rounds and _is_settled(before, crop):
            break
    straight = _place(pyramid, crop, networks)
    turned = _place(pyramid, Crop(crop.centre_px, crop.side_px, crop.roll_deg, mirrored=True), networks)
    points = (straight[0] + turned[0]) / 2
    box = np.concatenate([points.min(axis=0), points.max(axis=0)])
    return FaceDetection(points, max(straight[1], turned[1]), box, crop_around(points).roll_deg)


def crop_around(points_px: Float[np.ndarray, "468 2"]) -> Crop:
    """Returns the crop in which the landmark network expects a face with these 468 points (px of the picture)."""
    right = points_px[list(LEFT_EYE_CORNERS)].mean(axis=0) - points_px[list(RIGHT_EYE_CORNERS)].mean(axis=0)
    down = points_px[CHIN] - points_px[FOREHEAD]
    across = right + (down[1], -down[0])  # in a profile the eyes say nothing of the roll, chin and forehead do
    roll = np.arctan2(across[1], across[0])
    level = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    turned = points_px @ level.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    return Crop((low + high) / 2 @ level, CROP_OF_FACE * float((high - low).max()), float(np.rad2deg(roll)))


def _place(pyramid: Pyramid, crop: Crop, networks: FaceNetworks) -> tuple[Float[np.ndarray, "468 2"], float]:
    """Runs the landmark network on a crop. Returns the points' pixels and the network's score."""
    points, score = networks.place_landmarks(pyramid.sample(crop, LANDMARK_SIZE))
    if crop.mirrored:
        points = points[point_table().mirror_images]
    return in_picture(points[:, :2], crop.picture_from_crop(LANDMARK_SIZE)), score


def _whole(pyramid: Pyramid) -> list[Crop]:
    """Returns the square crop that contains the whole picture."""
    return [Crop((pyramid.size_px - 1) / 2, float(pyramid.size_px.max()), 0.0)]


def _parts(pyramid: Pyramid) -> list[Crop]:
    """Returns square crops of half the picture's longer side that overlap by half; none if the picture is too small."""
    side = float(pyramid.size_px.max()) / 2
    if side < FINDER_SIZE:
        return []
    width, height = pyramid.size_px
    columns, rows = (np.unique(np.clip(np.arange(3) * side / 2 + side / 2, 0, limit)) for limit in (width, height))
    return [Crop(np.array([x, y]) - 0.5, side, 0.0) for y in rows for x in columns]


def _find(pyramid: Pyramid, frames: Sequence[Crop], networks: FaceNetworks) -> tuple[FaceDetection, ...]:
    """Returns the faces in parts of a picture, best first. If an upright face has a very high score, rotated faces are
    not searched."""
    seen: list[tuple[float, Crop]] = []
    found: tuple[FaceDetection, ...] = ()
    for turns in ((0.0,), (90.0, 180.0, 270.0)):
        seen += [
            proposal
            for frame in frames
            for turn in turns
            for proposal in _seen(pyramid, Crop(frame.centre_px, frame.side_px, turn), networks)
        ]
        found = _verified(pyramid, _proposals(seen), networks)
        if found and found[0].score >= CERTAIN_SCORE:
            break
    return found


def _proposals(seen: Sequence[tuple[float, Crop]]) -> list[Crop]:
    """Returns crops of the detector's proposals, best first, one crop for each orientation of a face."""
    chosen: list[Crop] = []
    for _, crop in sorted(seen, key=lambda proposal: -proposal[0]):
        if not any(_is_same(crop, other) and _angle_deg(crop, other) < SAME_WAY_UP_DEG for other in chosen):
            chosen.append(crop)
    return chosen[:MAX_PROPOSALS]


def _seen(pyramid: Pyramid, frame: Crop, networks: FaceNetworks) -> Iterator[tuple[float, Crop]]:
    """Returns score and crop of each face that the detector finds in one square of the picture."""
    faces, scores = networks.find(pyramid.sample(frame, FINDER_SIZE))
    picture_from_crop = frame.picture_from_crop(FINDER_SIZE)
    centres: list[Float[np.ndarray, " 2"]] = []
    for cell in np.argsort(-scores, kind="stable")[:MAX_CELLS]:
        if scores[cell] < MIN_PROPOSAL or len(centres) >= MAX_PROPOSALS:
            return
        size = float(faces[cell, 1].max())
        if size <= 0.0 or any(np.linalg.norm(faces[cell, 0] - centre) < SAME_FACE * size for centre in centres):
            continue
        centres.append(faces[cell, 0])
        eyes = faces[cell, LEFT_EYE] - faces[cell, RIGHT_EYE]
        roll = frame.roll_deg + float(np.rad2deg(np.arctan2(eyes[1], eyes[0])))
        centre = in_picture(faces[cell, :1], picture_from_crop)[0]
        yield float(scores[cell]), Crop(centre, CROP_OF_FACE * size * frame.side_px / FINDER_SIZE, roll)


def _verified(pyramid: Pyramid, proposals: Sequence[Crop], networks: FaceNetworks) -> tuple[FaceDetection, ...]:
    """Returns the proposals that the landmark network confirms as faces, best first and without duplicates."""
    candidates = [_place(pyramid, crop, networks) for crop in proposals]
    chosen: list[FaceDetection] = []
    for points, _ in sorted(candidates, key=lambda candidate: -candidate[1]):
        crop = crop_around(points)
        if any(_is_same(crop, crop_around(face.landmarks_px)) for face in chosen):
            continue
        face = find_face_at(pyramid, crop, networks, min_rounds=MIN_ROUNDS - 1)
        if face.score >= MIN_SCORE and not any(
            _is_same(crop_around(face.landmarks_px), crop_around(other.landmarks_px)) for other in chosen
        ):
            chosen.append(face)
    return tuple(sorted(chosen, key=lambda face: -face.score))


def _is_same(a: Crop, b: Crop) -> bool:
    """Returns True if two crops show the same face, whatever their rotation."""
    return bool(np.linalg.norm(a.centre_px - b.centre_px) < SAME_FACE / CROP_OF_FACE * max(a.side_px, b.side_px))


def _is_settled(before: Crop, after: Crop) -> bool:
    """Returns True if two successive crops are almost the same."""
    step = max(float(np.linalg.norm(after.centre_px - before.centre_px)), abs(after.side_px - before.side_px))
    return step < SETTLED * after.side_px and _angle_deg(before, after) < SETTLED_DEG


def _angle_deg(a: Crop, b: Crop) -> float:
    """Returns the angle between the upward directions of two crops, 0 to 180."""
    return abs((a.roll_deg - b.roll_deg + 180.0) % 360.0 - 180.0)
