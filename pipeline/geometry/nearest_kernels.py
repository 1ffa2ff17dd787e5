"""Holds the compiled loops of ``pipeline.geometry.nearest``: they build and search a balanced tree of points, and find
the neighbours of a point in a grid of cubic cells."""

from typing import NamedTuple

import numpy as np

from rig.jit import njit

COLUMNS = 9  # of three cells each: those about a cell, and it
LEAF = 12  # points of a leaf, at most; with 4 to 24 it is as fast
DEEPEST = 64  # nodes that wait at once, more than any tree is deep


class Tree(NamedTuple):
    """Holds n points sorted as a balanced tree. Node i has the children 2 i + 1 and 2 i + 2, each with half of its
    points; the last ``2**levels`` nodes are leaves."""

    points: np.ndarray  # (n, 3), leaf after leaf
    row: np.ndarray  # (n): which of the points given each is
    boxes: np.ndarray  # (nodes, 6): least and greatest coordinates of a node's points
    levels: int


@njit(cache=True, nogil=True, error_model="numpy")
def sort_into_tree(points: np.ndarray, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts points (n, 3) into the leaves of a tree: each node's points are halved along the longest side of their
    bounding box. Returns the point indices in the order of the leaves, and the bounding boxes of all nodes."""
    row = np.arange(len(points))
    nodes = 2 ** (levels + 1) - 1
    boxes, spans = np.empty((nodes, 6)), np.empty((nodes, 2), np.int64)
    spans[0, 0], spans[0, 1] = 0, len(points)
    for node in range(nodes):
        first, last = spans[node]
        for axis in range(3):
            low, high = np.inf, -np.inf
            for k in range(first, last):
                at = points[row[k], axis]
                low, high = min(low, at), max(high, at)
            boxes[node, axis], boxes[node, axis + 3] = low, high
        if 2 * node + 2 < nodes:
            middle = (first + last) // 2
            halve(points[:, np.argmax(boxes[node, 3:] - boxes[node, :3])], row, first, middle, last)
            spans[2 * node + 1, 0], spans[2 * node + 1, 1] = first, middle
            spans[2 * node + 2, 0], spans[2 * node + 2, 1] = middle, last
    return row, boxes


@njit(cache=True, nogil=True, error_model="numpy")
def halve(values: np.ndarray, row: np.ndarray, first: int, middle: int, last: int) -> None:
    """Reorders ``row[first:last]`` so that no value before ``middle`` is greater than any value after it (C. A. R.
    Hoare, *Algorithm 65: Find*, 1961)."""
    low, high = first, last - 1
    while low < high:
        pivot = values[row[(low + high) // 2]]
        i, j = low, high
        while i <= j:
            while values[row[i]] < pivot:
                i += 1
            while values[row[j]] > pivot:
                j -= 1
            if i <= j:
                row[i], row[j] = row[j], row[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def square_to_box(x: float, y: float, z: float, box: np.ndarray) -> float:
    """Returns the squared distance of a point to a box; 0 inside the box."""
    dx = max(box[0] - x, x - box[3], 0.0)
    dy = max(box[1] - y, y - box[4], 0.0)
    dz = max(box[2] - z, z - box[5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True, error_model="numpy")
def find_nearest(
    tree: Tree, places: np.ndarray, within: float, distance: np.ndarray, near: np.ndarray, first: int, last: int
) -> None:
    """Finds the tree points nearest to the query points ``first`` to ``last`` of ``places`` (n, 3), sorted by distance.
    Fills ``distance`` and ``near`` (both n, count) with the distances and point indices. Of equally distant points, the
    lower index comes first. If fewer than the requested points are nearer than ``within``, the missing distances are
    infinite and the missing indices are the number of points."""
    points, row, boxes, levels = tree
    leaves, total, count = 2**levels - 1, len(points), distance.shape[1]
    node_at, first_at, last_at = np.empty(DEEPEST, np.int64), np.empty(DEEPEST, np.int64), np.empty(DEEPEST, np.int64)
    square_at = np.empty(DEEPEST)
    for n in range(first, last):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        squares, rows = distance[n], near[n]  # squared until the search ends
        squares[:], rows[:] = within * within, -1
        worst = squares[count - 1]
        node_at[0], first_at[0], last_at[0], square_at[0] = 0, 0, total, square_to_box(x, y, z, boxes[0])
        waiting = 1
        while waiting > 0:
            waiting -= 1
            if square_at[waiting] > worst:
                continue
            node, begin, end = node_at[waiting], first_at[waiting], last_at[waiting]
            while node < leaves:  # down to the nearer child's leaf; the other one waits
                middle, left = (begin + end) // 2, 2 * node + 1
                to_left, to_right = square_to_box(x, y, z, boxes[left]), square_to_box(x, y, z, boxes[left + 1])
                if to_left <= to_right:
                    other, other_begin, other_end, farther = left + 1, middle, end, to_right
                    node, end = left, middle
                else:
                    other, other_begin, other_end, farther = left, begin, middle, to_left
                    node, begin = left + 1, middle
                if farther <= worst:
                    node_at[waiting], first_at[waiting], last_at[waiting] = other, other_begin, other_end
                    square_at[waiting] = farther
                    waiting += 1
            for k in range(begin, end):
                dx, dy, dz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
                square = dx * dx + dy * dy + dz * dz
                if square < worst or (square == worst and row[k] < rows[count - 1]):
                    at = count - 1
                    while at > 0 and square <= squares[at - 1]:
                        if square == squares[at - 1] and row[k] > rows[at - 1]:
                            break
                        squares[at], rows[at] = squares[at - 1], rows[at - 1]
                        at -= 1
                    squares[at], rows[at] = square, row[k]
                    worst = squares[count - 1]
        for k in range(count):
            if rows[k] < 0:
                squares[k], rows[k] = np.inf, total
            else:
                squares[k] = np.sqrt(squares[k])


@njit(cache=True, nogil=True)
def columns_about(cell: int, keys: np.ndarray, spans: np.ndarray, ranges: np.ndarray) -> None:
    """Fills ``ranges`` (9, 2) with the first and last positions in the sorted ``keys`` of the points in the 27 cells
    around ``cell``. Three cells that are adjacent in z have consecutive keys, so nine ranges suffice. ``keys`` and
    ``spans`` are those of ``nearest.Cells``."""
    for column in range(COLUMNS):
        low = cell + ((column // 3 - 1) * spans[1] + column % 3 - 1) * spans[2] - 1
        ranges[column, 0] = np.searchsorted(keys, low)
        ranges[column, 1] = np.searchsorted(keys, low + 3)
