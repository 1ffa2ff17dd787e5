"""Compiled loops of ``pipeline.multiview.visual_hull``."""

import numpy as np

from pipeline.compiled import njit
from pipeline.imaging.projection_kernels import LENS, NEAREST_MM, distorted, placed
from pipeline.imaging.sampling_kernels import sample

COARSE = 4  # fine cells along the side of a coarse one


@njit(cache=True)
def mark_occupied(known: np.ndarray, active: np.ndarray) -> None:
    """Marks the fine corners of every coarse cell that is active; ``known`` is changed."""
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
    """Raises ``field`` to this view's distance (mm) at the points of the active blocks, and counts the view there."""
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
    """Is (bi, bj, bk) the first active block, in index order, that the point belongs to?"""
    for a in range((i - 1) // split if i % split == 0 else i // split, i // split + 1):
        for b in range((j - 1) // split if j % split == 0 else j // split, j // split + 1):
            for c in range((k - 1) // split if k % split == 0 else k // split, k // split + 1):
                blocks = active.shape[0]
                if 0 <= a < blocks and 0 <= b < blocks and 0 <= c < blocks and active[a, b, c]:
                    return a == bi and b == bj and c == bk
    return False


@njit(cache=True)
def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (float32, in grid steps) and triangles (int32, wound outwards) of the zero level; negative is inside."""
    nx, ny, nz = field.shape
    index = np.full((nx - 1, ny - 1, nz - 1), -1, np.int32)
    vertices = np.empty((nx * ny * nz // 8 + 1024, 3), np.float32)
    count = 0
    for i in range(nx - 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                total, x, y, z = 0, 0.0, 0.0, 0.0
                first = field[i, j, k] < 0
                mixed = False
                for a in range(2):
                    for b in range(2):
                        for c in range(2):
                            mixed = mixed or (field[i + a, j + b, k + c] < 0) != first
                if not mixed:
                    continue
                for axis in range(3):
                    for a in range(2):
                        for b in range(2):
                            di, dj, dk = (0, a, b) if axis == 0 else ((a, 0, b) if axis == 1 else (a, b, 0))
                            ei, ej, ek = di + (axis == 0), dj + (axis == 1), dk + (axis == 2)
                            low, high = field[i + di, j + dj, k + dk], field[i + ei, j + ej, k + ek]
                            if (low < 0) != (high < 0):
                                t = low / (low - high)
                                x += di + t * (ei - di)
                                y += dj + t * (ej - dj)
                                z += dk + t * (ek - dk)
                                total += 1
                vertices[count, 0], vertices[count, 1], vertices[count, 2] = i + x / total, j + y / total, k + z / total
                index[i, j, k] = count
                count += 1
    faces = np.empty((6 * count + 16, 3), np.int32)
    made = 0
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                here = field[i, j, k] < 0
                for axis in range(3):
                    if axis == 0:
                        other = field[i + 1, j, k] < 0
                        a, b, c, d = index[i, j - 1, k - 1], index[i, j, k - 1], index[i, j, k], index[i, j - 1, k]
                    elif axis == 1:
                        other = field[i, j + 1, k] < 0
                        a, b, c, d = index[i - 1, j, k - 1], index[i - 1, j, k], index[i, j, k], index[i, j, k - 1]
                    else:
                        other = field[i, j, k + 1] < 0
                        a, b, c, d = index[i - 1, j - 1, k], index[i, j - 1, k], index[i, j, k], index[i - 1, j, k]
                    if here == other:
                        continue
                    if not here:  # the outside lies towards the low end of the edge
                        b, d = d, b
                    faces[made] = (a, b, c)
                    faces[made + 1] = (a, c, d)
                    made += 2
    return vertices[:count].copy(), faces[:made].copy()
