"""Estimates the poses of all cameras and boards (the pose graph), from which the bundle adjustment starts.

Each view gives camera_from_board with two ambiguities: the image of a plane allows two poses (IPPE), and a checkerboard
may be turned (``Board.turns``). The relative pose of two cameras must be the same in every shot. Each candidate for two
cameras' relative pose is therefore tested on all shared shots, and the candidate that fits most shots is chosen. A
maximum spanning tree over pairs joins all cameras. The program refuses a tie between two candidates, cameras without
common shots, and a camera whose views agree with no other camera. A camera that agrees with no other has mirrored
pictures or misnamed shots."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from calibration.adjustment.intrinsics import Lens, board_poses_of, estimate_lens
from calibration.adjustment.state import BundleState
from calibration.board.board import Board
from calibration.board.corners import Found
from calibration.board.detection import Detections, View
from rig.errors import EigenheadError
from rig.geometry import RigidTransform, rigid_fit
from rig.messages.message import Message, compose

# Distances below are in squares of the board as the camera sees it. A single view gives depth to one percent of the
# camera's distance, half a square of a usual board; a turned or mirrored board is off by its whole length.
AGREE_SQUARES = 1.0
SECOND_POSE_RATIO = 3.0  # the second pose of IPPE counts if its residual is within this factor of the first's
CANDIDATES_MOST = 60  # relative poses tested for a pair of cameras
SAME_DEG = 15.0  # candidates whose rotations differ by less are one hypothesis


class PoseGraphError(EigenheadError):
    """Reports that the views do not determine the cameras' relative poses. ``reasons`` name the cameras."""

    def __init__(self, reasons: Iterable[Message]) -> None:
        self.reasons = tuple(reasons)
        super().__init__(compose("cameras-not-joined", reasons=self.reasons))


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Holds the possible poses camera_from_board of one view: each pose from IPPE combined with each turn of the board.
    ``turns`` are indices into ``Board.turns()``."""

    poses: tuple[RigidTransform, ...]
    turns: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """Holds the relative pose of two cameras with common shots.

    ``a_from_b`` is the candidate pose that fits most of the ``shared`` common shots, and ``support`` counts the shots
    that it fits. ``ambiguous`` is True if another pose fits as many shots."""

    a: str
    b: str
    a_from_b: RigidTransform
    support: int
    shared: int
    ambiguous: bool

    @property
    def consistent(self) -> bool:
        """Returns whether the relative pose fits at least half of the shared shots."""
        return self.support >= max(1, self.shared / 2)


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Holds the poses of all cameras and boards in the frame of the camera ``names[0]``. The corners of ``views`` are
    reordered by the turn of their board; ``strays`` are views that fit in no turn."""

    names: tuple[str, ...]
    shots: tuple[str, ...]
    cameras: dict[str, RigidTransform]  # camera_from_world
    boards: dict[str, RigidTransform]  # world_from_board
    views: tuple[View, ...]
    strays: tuple[View, ...]

    def state(self, lenses: dict[str, Lens]) -> BundleState:
        """Returns the initial state of the bundle adjustment, with the intrinsics of ``lenses`` and no time offsets."""
        return BundleState(
            np.stack([lenses[name].intrinsics.values() for name in self.names]),
            np.stack([self.cameras[name].rotation for name in self.names]),
            np.stack([self.cameras[name].translation for name in self.names]),
            np.stack([self.boards[shot].rotation for shot in self.shots]),
            np.stack([self.boards[shot].translation for shot in self.shots]),
            np.zeros(len(self.names)),
            np.zeros((len(self.shots), 6)),
        )


def build_graph(detections: Detections, lenses: dict[str, Lens]) -> Graph:
    """Estimates the poses of all cameras and boards in one frame. Raises PoseGraphError if the shared views do not
    connect all cameras."""
    board = detections.board
    names = tuple(name for name in detections.sizes if name in lenses)
    options = {(v.camera, v.shot): _candidates(v, lenses[v.camera], board) for v in detections.views}
    edges = tuple(edge for a, b in combinations(names, 2) if (edge := _edge(a, b, options, board)) is not None)
    good = [edge for edge in edges if edge.consistent and not edge.ambiguous]
    cameras = _span(names, good)
    if len(cameras) < len(names):
        raise PoseGraphError(_reasons(detections, lenses, names, edges, options))
    boards, views, strays = _place_boards(detections.views, cameras, options, board)
    shots = tuple(shot for shot in detections.shots if shot in boards)
    return Graph(names, shots, cameras, boards, tuple(views), tuple(strays))


def _candidates(view: View, lens: Lens, board: Board) -> Candidates:
    fits = board_poses_of(view.found, lens.intrinsics, board)
    poses = [lens.poses[view.shot]] if view.shot in lens.poses else [fits[0][0]]
    if len(fits) > 1 and fits[1][1] < SECOND_POSE_RATIO * max(fits[0][1], lens.noise_px):
        refined = poses[0].rotation
        # The lens's own bundle may have settled on either pose; the other of the two is the alternative.
        poses.append(max((pose for pose, _ in fits), key=lambda pose: _angle_deg(pose.rotation, refined)))
    corners = board.corners()
    motions = [rigid_fit(corners, corners[turn]) for turn in board.turns()]  # of corner i to corner turn[i]
    pairs = [(pose @ motion.inverse(), turn) for pose in poses for turn, motion in enumerate(motions)]
    return Candidates(tuple(pose for pose, _ in pairs), tuple(turn for _, turn in pairs))


def _edge(a: str, b: str, options: dict[tuple[str, str], Candidates], board: Board) -> Edge | None:
    shots = sorted(
        {shot for camera, shot in options if camera == a} & {shot for camera, shot in options if camera == b}
    )
    if not shots:
        return None
    # Turning both boards alike changes nothing, so turns are tried on a only.
    of_a = [options[a, shot].poses for shot in shots]
    of_b = [
        [p for p, t in zip(options[b, shot].poses, options[b, shot].turns, strict=True) if t == 0] for shot in shots
    ]
    tried = [p @ q.inverse() for ps, qs in zip(of_a, of_b, strict=True) for p in ps for q in qs]
    tried = tried[:: max(1, len(tried) // CANDIDATES_MOST)]
    distances = np.stack([_disagreement(candidate, of_a, of_b, board) for candidate in tried])
    support = (distances < AGREE_SQUARES).sum(axis=1)
    costs = np.minimum(distances, AGREE_SQUARES).sum(axis=1)
    best = int(np.argmin(costs))
    rivals = [i for i in range(len(tried)) if _angle_deg(tried[i].rotation, tried[best].rotation) > SAME_DEG]
    ambiguous = any(support[i] >= support[best] for i in rivals)
    return Edge(a, b, tried[best], int(support[best]), len(shots), ambiguous)


def _disagreement(
    a_from_b: RigidTransform,
    of_a: Sequence[Sequence[RigidTransform]],
    of_b: Sequence[Sequence[RigidTransform]],
    board: Board,
) -> Float[np.ndarray, " s"]:
    """Returns, for each shot, the smallest image distance (in squares) of board poses seen by cameras a and b."""
    corners = _outline(board)
    values = []
    for poses_a, poses_b in zip(of_a, of_b, strict=True):
        corners_world = np.stack([pose.apply(corners) for pose in poses_a])
        put = np.stack([(a_from_b @ pose).apply(corners) for pose in poses_b])
        values.append(_squares_apart(corners_world[:, None], put[None], board).min())
    return np.array(values)


def _squares_apart(
    corners_world: Float[np.ndarray, "*k n 3"], put: Float[np.ndarray, "*j n 3"], board: Board
) -> Float[np.ndarray, "*b"]:
    """Returns the image distance between two sets of corners, in sides of a square's image. The distance is large if
    ``put`` lies behind the camera."""
    depth = corners_world[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.linalg.norm(corners_world[..., :2] / depth - put[..., :2] / put[..., 2:], axis=-1) * depth[..., 0]
    apart = np.where((put[..., 2] > 0) & (corners_world[..., 2] > 0), apart, 1e3 * board.square_mm)
    return np.sqrt((apart**2).mean(axis=-1)) / board.square_mm


def _outline(board: Board) -> Float[np.ndarray, "4 3"]:
    columns, rows = board.grid
    corners = board.corners().reshape(rows, columns, 3)
    return np.stack([corners[0, 0], corners[0, -1], corners[-1, -1], corners[-1, 0]])


def _angle_deg(first: Float[np.ndarray, "3 3"], second: Float[np.ndarray, "3 3"]) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(first.T @ second) - 1) / 2, -1, 1))))


def _span(names: Sequence[str], edges: Sequence[Edge]) -> dict[str, RigidTransform]:
    """Returns camera_from_world of all cameras that a maximum spanning tree (Prim's algorithm) reaches from the camera
    ``names[0]``, whose frame is the world."""
    placed = {names[0]: RigidTransform.identity()}
    while True:
        border = [edge for edge in edges if (edge.a in placed) != (edge.b in placed)]
        if not border:
            return placed
        edge = max(border, key=lambda e: e.support)
        if edge.b in placed:
            placed[edge.a] = edge.a_from_b @ placed[edge.b]
        else:
            placed[edge.b] = edge.a_from_b.inverse() @ placed[edge.a]


def _place_boards(
    views: Sequence[View], cameras: dict[str, RigidTransform], options: dict[tuple[str, str], Candidates], board: Board
) -> tuple[dict[str, RigidTransform], list[View], list[View]]:
    """Returns world_from_board by shot, the views reordered by the board's turn, and the views that fit in no turn."""
    boards: dict[str, RigidTransform] = {}
    retained, strays = [], []
    corners, turns = _outline(board), board.turns()
    for shot in sorted({view.shot for view in views}):
        inside = [view for view in views if view.shot == shot]
        trials = [cameras[view.camera].inverse() @ pose for view in inside for pose in options[view.camera, shot].poses]
        tables = [_fits(trial, inside, cameras, options, corners, board) for trial in trials]
        best = int(np.argmin([sum(min(distance, 2 * AGREE_SQUARES) for distance, _ in table) for table in tables]))
        boards[shot] = trials[best]
        for view, (distance, turn) in zip(inside, tables[best], strict=True):
            if distance > 2 * AGREE_SQUARES:
                strays.append(view)
            else:
                retained.append(_turned(view, turns[turn]))
    return boards, retained, strays


def _fits(
    world_from_board: RigidTransform,
    views: Sequence[View],
    cameras: dict[str, RigidTransform],
    options: dict[tuple[str, str], Candidates],
    corners: np.ndarray,
    board: Board,
) -> list[tuple[float, int]]:
    """Returns, for each view, the image distance (in squares) of the board at ``world_from_board`` in its best turn,
    and the index of this turn."""
    table = []
    for view in views:
        option = options[view.camera, view.shot]
        put = (cameras[view.camera] @ world_from_board).apply(corners)
        corners_world = np.stack([pose.apply(corners) for pose in option.poses])
        distances = _squares_apart(corners_world, np.broadcast_to(put, corners_world.shape), board)
        best = int(np.argmin(distances))
        table.append((float(distances[best]), option.turns[best]))
    return table


def _turned(view: View, turn: Int[np.ndarray, " n"]) -> View:
    ids = turn[view.found.ids]
    order = np.argsort(ids)
    return replace(view, found=replace(view.found, ids=ids[order], corners=view.found.corners[order]))


def _reasons(
    detections: Detections,
    lenses: dict[str, Lens],
    names: Sequence[str],
    edges: Sequence[Edge],
    options: dict[tuple[str, str], Candidates],
) -> list[Message]:
    """Returns one message for each group of cameras that is not connected to the largest group."""
    good = [edge for edge in edges if edge.consistent and not edge.ambiguous]
    groups: list[set[str]] = []
    for name in names:
        if not any(name in group for group in groups):
            reached = _span([name, *(other for other in names if other != name)], good)
            groups.append(set(reached))
    groups.sort(key=len, reverse=True)
    main = groups[0]
    return [_reason(group, main, detections, lenses, edges, options) for group in groups[1:]]


def _reason(
    group: set[str],
    main: set[str],
    detections: Detections,
    lenses: dict[str, Lens],
    edges: Sequence[Edge],
    options: dict[tuple[str, str], Candidates],
) -> Message:
    who, others = sorted(group), sorted(main)
    between = [edge for edge in edges if len({edge.a, edge.b} & group) == 1 and len({edge.a, edge.b} & main) == 1]
    if not between:
        return compose("group-shares-no-shot", cameras=who, others=others)
    torn = [edge for edge in between if not edge.consistent]
    if torn and len(group) == 1 and _fits_when_mirrored(who[0], main, detections, lenses, options):
        return compose("camera-mirrored", camera=who[0])
    if torn:
        return compose("group-contradicts", cameras=who, others=others, shared=max(edge.shared for edge in torn))
    return compose("group-joins-twice", cameras=who, others=others)


def _fits_when_mirrored(
    name: str,
    main: set[str],
    detections: Detections,
    lenses: dict[str, Lens],
    options: dict[tuple[str, str], Candidates],
) -> bool:
    board, size = detections.board, detections.sizes[name]
    if board.kind == "charuco":
        return False  # a mirrored marker is not detected in the first place
    views = [view for view in detections.views if view.camera == name]
    lens = estimate_lens([replace(view, found=_mirror(view.found, board, size[0])) for view in views], size, board)
    flipped = {view.shot: replace(view, found=_mirror(view.found, board, size[0])) for view in views}
    trial = dict(options) | {(name, shot): _candidates(view, lens, board) for shot, view in flipped.items()}
    checked = [_edge(name, other, trial, board) for other in sorted(main)]
    edges = [edge for edge in checked if edge is not None and edge.shared >= 2]
    return bool(edges) and sum(edge.consistent for edge in edges) > len(edges) / 2


def _mirror(detection: Found, board: Board, width: int) -> Found:
    """Returns the corners as they would be detected in the mirrored picture; ``width`` is its width, px."""
    columns, rows = board.grid
    index = np.arange(board.corner_count).reshape(rows, columns)
    # A mirrored row starts with the same colour where the number of columns of squares is odd; else turn the rows over.
    order = (index[:, ::-1] if board.columns % 2 == 1 else index[::-1]).ravel()
    ids = order[detection.ids]
    corners = detection.corners * [-1.0, 1.0] + [width - 1.0, 0.0]
    arranged = np.argsort(ids)
    return replace(detection, ids=ids[arranged], corners=corners[arranged])
