"""Compiled loops of ``pipeline.multiview.visual_hull``."""

import numpy as np

from pipeline.geometry.projection_kernels import LENS, NEAREST_MM, distorted, placed
from pipeline.imaging.sampling_kernels import sample
from rig.jit import njit

COARSE = 4  # fine cells along the side of a coarse one


@njit(cache=True)
def mark_occupied(known: np.ndarray, active: np.ndarray) -> None:
    """Marks all fine nodes in the ``active`` cells of the coarse grid, borders included: changes ``known`` in place. A
    coarse cell has ``COARSE`` fine ones along each side."""
    for i, j, k in np.argwhere(active):
        known[
            i * COARSE : (i + 1) * COARSE + 1, j * COARSE : (j + 1) * COARSE + 1, k * COARSE : (k + 1) * COARSE + 1
        ] = True


@njit(cache=True, nogil=True)
def carve_view(
    field: np.ndarray,
    votes: np.ndarray,
    active: np.ndarray,
    split: int,
    corner: np.ndarray,
    step: float,
    p: np.ndarray,
    distance: np.ndarray,
) -> None:
    """Raises ``field`` (mm, positive outside) to one view's signed distance at the nodes of the active blocks, and
    counts the view in ``votes``, in place. Nodes outside the view are left alone.

    ``active`` (b, b, b) marks blocks of ``split`` steps along each side; ``corner`` (world, mm) and ``step`` (mm) place
    the nodes; ``p`` is the camera's row; ``distance`` (px) the silhouette's.
    """
    height, width = distance.shape
    lens = p[LENS:]
    blocks = active.shape[0]
    for block in range(blocks * blocks * blocks):
        bi, bj, bk = block // (blocks * blocks), (block // blocks) % blocks, block % blocks
        if not active[bi, bj, bk]:
            continue
        # A block owns its low faces, and the outermost ones the high face too, so that no point is met twice ...
        for i in range(bi * split, (bi + 1) * split + 1):
            for j in range(bj * split, (bj + 1) * split + 1):
                for k in range(bk * split, (bk + 1) * split + 1):
                    # ... unless the block that owns it is not active.
                    if not owner_of(i, j, k, split, bi, bj, bk, active):
                        continue
                    x, y, z = corner[0] + i * step, corner[1] + j * step, corner[2] + k * step
                    cx, cy, cz = placed(p, x, y, z)
                    if cz <= NEAREST_MM:
                        continue
                    column, row = distorted(cx / cz, cy / cz, lens)
                    if not (column >= 0 and row >= 0 and column < width - 1 and row < height - 1):
                        continue
                    value = np.float32(sample(distance, column, row) * cz / lens[0])
                    votes[i, j, k] += 1
                    if value > field[i, j, k]:
                        field[i, j, k] = value


@njit(cache=True, nogil=True, inline="always")
def owner_of(i: int, j: int, k: int, split: int, bi: int, bj: int, bk: int, active: np.ndarray) -> bool:
    """Tells whether (bi, bj, bk) is the first active block, in the order of indices, that contains the node (i, j, k),
    so that a node on the border of several blocks is visited once."""
    for a in range((i - 1) // split if i % split == 0 else i // split, i // split + 1):
        for b in range((j - 1) // split if j % split == 0 else j // split, j // split + 1):
            for c in range((k - 1) // split if k % split == 0 else k // split, k // split + 1):
                blocks = active.shape[0]
                if 0 <= a < blocks and 0 <= b < blocks and 0 <= c < blocks and active[a, b, c]:
                    return a == bi and b == bj and c == bk
    return False
