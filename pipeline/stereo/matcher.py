"""Compares windows of the views with each other, at one image size, by compiled loops or on a GPU.

Loops and GPU run the same algorithm; the loops are the reference. The GPU computes in single precision and in another
order of operations, so depths differ by hundredths of a millimetre.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32

from pipeline.stereo.depth_range import DepthRange
from pipeline.stereo.matching_kernels import Sight, farthest, make_scratch, propagate, slide, sweep_view
from pipeline.stereo.stack import SHADES, Stack
from rig.render.compute import ComputeDevice, DeviceArray

Plane = Float32[np.ndarray, "h w"]

SHADERS = Path(__file__).with_name("shaders")
GROUP = 8  # invocations across and down of one group, as in shaders/matching.glsl


class Planes(NamedTuple):
    """Holds the current plane of each pixel of a view, and its matching cost. The arrays are changed in place."""

    depth: Plane  # mm; 0 where there is none
    slopes: Float32[np.ndarray, "h w 2"]  # by x and y, mm a pixel
    cost: Plane  # below 0: not yet known
    fresh: Bool[np.ndarray, "h w"]  # neighbours have not tried it yet


@runtime_checkable  # the tests check types of calls
class Matcher(Protocol):
    """Declares the interface of an object that compares windows of one view with neighbouring views; each window lies
    on a plane."""

    def sweep(
        self, room: DepthRange, strides: Int32[np.ndarray, "h w"], labels: int
    ) -> Float32[np.ndarray, "h w labels"]:
        """Returns the matching cost at ``labels`` depths, evenly spaced through the range of each pixel.

        At a pixel with a stride of n only every n-th depth is matched; the other costs are interpolated.
        """
        ...

    def propagate(self, planes: Planes, parity: int, steps_px: Sequence[int], same_mm: float) -> None:
        """Lets pixels of one colour of a chequerboard (``parity`` 0 or 1) take over cheaper planes of their neighbours.
        Changes ``planes`` in place; ``matching_kernels.propagate`` describes the method."""
        ...

    def slide(self, most_px: float, depth: Plane, slopes: Float32[np.ndarray, "h w 2"]) -> tuple[Plane, Plane, Plane]:
        """Moves each plane along its ray by one least-squares step, at most ``most_px`` pixels in the neighbours'
        images. Returns the new depths (mm), their information (mm^-2), and the correlation of the windows (0 to 1)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Matching:
    """Holds all views at one image size, and the parameters of their comparison.

    Attributes:
        stack: the views.
        neighbours: for each view, the views that it is compared with.
        pattern: offsets of a window's samples from its middle, across and down, px.
        contrast_levels: difference from the middle's grey value at which a sample has half weight.
        device: GPU for the comparison; None uses compiled loops.
        uploaded: the stack's pixels and distances on the device.
    """

    stack: Stack
    neighbours: Sequence[Int[np.ndarray, " _"]]
    pattern: Float32[np.ndarray, "2 s"]
    contrast_levels: float
    device: ComputeDevice | None = None
    uploaded: tuple[DeviceArray, ...] = ()

    def matcher(self, view: int) -> Matcher:
        """Returns a matcher for one view, which only one thread may use at a time."""
        if self.device is None:
            others = self.neighbours[view]
            return LoopMatcher(self.stack.match_arguments(view, others, self.pattern, self.contrast_levels))
        return ShaderMatcher(self, view, self.device)


@contextmanager
def matching_on(
    device: ComputeDevice | None,
    stack: Stack,
    neighbours: Sequence[Int[np.ndarray, " _"]],
    pattern: Float32[np.ndarray, "2 s"],
    contrast_levels: float,
) -> Iterator[Matching]:
    """Uploads a stack to the GPU for the duration of a ``with`` block, and yields its ``Matching``. Without a GPU, or
    if the stack is too large for it, compiled loops do the matching."""
    if device is None or stack.pairs.nbytes > device.largest_array:
        yield Matching(stack, neighbours, pattern, contrast_levels)
        return
    with device.uploaded(stack.pairs, stack.distance_px, np.ascontiguousarray(pattern.T)) as held:
        yield Matching(stack, neighbours, pattern, contrast_levels, device, held)


class LoopMatcher:
    """Compares the windows of one view by compiled loops."""

    def __init__(self, sight: Sight) -> None:
        self._sight, self._scratch = sight, make_scratch(sight)

    def sweep(
        self, room: DepthRange, strides: Int32[np.ndarray, "h w"], labels: int
    ) -> Float32[np.ndarray, "h w labels"]:
        """Returns the matching cost at ``labels`` depths through the range of each pixel, as ``Matcher.sweep``."""
        cost = np.empty((*room.near.shape, labels), np.float32)
        sweep_view(self._sight, self._scratch, room.near, room.far, room.slopes, strides, cost)
        return cost

    def propagate(self, planes: Planes, parity: int, steps_px: Sequence[int], same_mm: float) -> None:
        """Lets pixels take over cheaper planes of their neighbours, as ``Matcher.propagate``."""
        steps = np.array(steps_px)
        propagate(
            self._sight, self._scratch, parity, steps, same_mm, planes.fresh, planes.depth, planes.slopes, planes.cost
        )

    def slide(self, most_px: float, depth: Plane, slopes: Float32[np.ndarray, "h w 2"]) -> tuple[Plane, Plane, Plane]:
        """Moves planes by one least-squares step, as ``Matcher.slide``."""
        place_mm, information, likeness = np.empty_like(depth), np.empty_like(depth), np.empty_like(depth)
        slide(self._sight, self._scratch, most_px, depth, slopes, place_mm, information, likeness)
        return place_mm, information, likeness


class ShaderMatcher:
    """Compares the windows of one view by compute shaders on a GPU."""

    def __init__(self, matching: Matching, view: int, device: ComputeDevice) -> None:
        stack, others = matching.stack, matching.neighbours[view]
        self._device, (pairs, distances, pattern) = device, matching.uploaded
        self._shared = (pairs, distances, pack_ways(stack, view, others), pattern)
        self._constants = {
            "SAMPLES": matching.pattern.shape[1],
            "VIEWS": max(1, *(len(each) for each in matching.neighbours)),
        }
        self._size = int(stack.size[view][0]), int(stack.size[view][1])
        self._uniforms = {
            "start": int(stack.offset[view]),
            "size": self._size,
            "view_count": len(others),
            "noise": float(stack.noise[view]),
            "contrast": matching.contrast_levels * SHADES,
            "reach": float(farthest(matching.pattern)),
        }

    def sweep(
        self, room: DepthRange, strides: Int32[np.ndarray, "h w"], labels: int
    ) -> Float32[np.ndarray, "h w labels"]:
        """Returns the matching cost at ``labels`` depths through the range of each pixel, as ``Matcher.sweep``."""
        cost = np.empty((*room.near.shape, labels), np.float32)
        self._run("sweep.comp", [room.near, room.far, room.slopes, strides, cost], [4], labels=labels)
        return cost

    def propagate(self, planes: Planes, parity: int, steps_px: Sequence[int], same_mm: float) -> None:
        """Lets pixels take over cheaper planes of their neighbours, as ``Matcher.propagate``."""
        flags, steps = planes.fresh.astype(np.uint32), np.array(steps_px, np.int32)
        self._run(
            "propagate.comp", [flags, planes.depth, planes.slopes, planes.cost, steps], [0, 1, 2, 3],
            across=2, parity=parity, step_count=len(steps), same_mm=same_mm,
        )  # fmt: skip
        planes.fresh[:] = flags != 0

    def slide(self, most_px: float, depth: Plane, slopes: Float32[np.ndarray, "h w 2"]) -> tuple[Plane, Plane, Plane]:
        """Moves planes by one least-squares step, as ``Matcher.slide``."""
        results = np.empty((*depth.shape, 4), np.float32)
        self._run("slide.comp", [depth, slopes, results], [2], most_px=most_px)
        return results[:, :, 0].copy(), results[:, :, 1].copy(), results[:, :, 2].copy()

    def _run(
        self, shader: str, arrays: list[np.ndarray], written: list[int], *, across: int = 1, **uniforms: float
    ) -> None:
        """Runs a shader over the view's pixels; one invocation takes ``across`` pixels of a row. ``written``: the
        ``arrays`` that the shader writes; they are bound after the arrays that all shaders share."""
        width, height = self._size
        groups = -(-width // (across * GROUP)), -(-height // GROUP)
        first = len(self._shared)
        self._device.run(
            SHADERS / shader, groups, [*self._shared, *arrays], [first + k for k in written],
            constants=self._constants, uniforms={**self._uniforms, **uniforms},
        )  # fmt: skip


def pack_ways(stack: Stack, view: int, others: Int[np.ndarray, " m"]) -> Float32[np.ndarray, "m 16"]:
    """Packs the maps from a view's pixels to other views, one row for each, in the memory layout of the struct Way in
    shaders/matching.glsl. The last three numbers of a row are integers. The result has at least one row, since no GPU
    buffer may be empty."""
    ways = stack.homographies(view, others)
    packed = np.zeros((max(len(ways), 1), 16), np.float32)
    packed[: len(ways), :12], packed[: len(ways), 12] = ways[:, :12], ways[:, 15]
    packed.view(np.int32)[: len(ways), 13:] = ways[:, [14, 12, 13]]
    return packed
