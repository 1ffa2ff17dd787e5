"""Computes how long a job would take on more cores, from the processor seconds of its slices in a trace.

Work outside of shared loops stays on one core. A loop's slices are scheduled as in ``pipeline.compute.threads``: the
next one goes to the core that is free first. Cores are assumed to be alike and not to delay each other (by slow memory,
or the interpreter's lock), so that the seconds are a lower bound. Nested loops have the cores that the slices around
them leave. A stage in the background takes no longer than the stages before it, if there are cores for both.
"""

import heapq
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pipeline.compute.threads import cut, slice_count
from pipeline.compute.trace import FORMAT


@dataclass(slots=True, eq=False)
class Slice:
    """Holds one slice of a loop: its processor seconds without those of loops inside it, and these loops."""

    first: int
    serial_s: float
    loops: "list[Loop]" = field(default_factory=list)

    def seconds(self, cores: int) -> float:
        """Returns how long the slice takes if the loops inside it have so many cores."""
        return self.serial_s + sum(loop.seconds(cores) for loop in self.loops)


@dataclass(slots=True, eq=False)
class Loop:
    """Holds a loop over ``count`` items, and the slices into which it was cut for threads. If ``single``, it was cut
    into single items and cannot be cut further."""

    name: str
    count: int
    single: bool
    slices: list[Slice] = field(default_factory=list)

    def seconds(self, cores: int) -> float:
        """Returns how long the loop takes if it is cut for, and run on, so many cores."""
        groups = self._groups(cores)
        within = max(1, cores // max(1, len(groups)))
        return schedule([sum(part.seconds(within) for part in group) for group in groups], cores)

    def _groups(self, cores: int) -> list[list[Slice]]:
        """The recorded slices by the coarser ones that so many threads make."""
        ordered = sorted(self.slices, key=lambda part: part.first)
        if self.single:
            return [[part] for part in ordered]
        bounds = cut(self.count, slice_count(cores))
        groups = ([part for part in ordered if first <= part.first < last] for first, last in bounds)
        return [group for group in groups if group]


@dataclass(slots=True, eq=False)
class Section:
    """Holds the work of a stage or of a part of one: processor seconds of all threads, and the loops that threads
    share."""

    name: str
    cpu_s: float = 0.0
    loops: list[Loop] = field(default_factory=list)

    @property
    def shared_s(self) -> float:
        """Returns the processor seconds within shared loops."""
        return sum(loop.seconds(1) for loop in self.loops)

    @property
    def serial_s(self) -> float:
        """Returns the processor seconds that no other core can take over."""
        return max(0.0, self.cpu_s - self.shared_s)

    def seconds(self, cores: int) -> float:
        """Returns how long the section takes on so many cores."""
        return self.serial_s + sum(loop.seconds(cores) for loop in self.loops)


@dataclass(frozen=True, slots=True, eq=False)
class JobWork:
    """Holds the work of a job: by stage in their order, with ``start`` (what was loaded before) and ``between`` the
    stages; and by part, named "stage: part"."""

    stages: tuple[Section, ...]
    parts: tuple[Section, ...]
    beside: tuple[tuple[Section, Section], ...] = ()  # of stages: in the background, and those before it

    @property
    def cpu_s(self) -> float:
        """Returns the processor seconds of all stages."""
        return sum(stage.cpu_s for stage in self.stages)

    @property
    def serial_s(self) -> float:
        """Returns the processor seconds that no other core can take over."""
        hidden = sum(min(behind.serial_s, before.serial_s) for behind, before in self.beside)
        return sum(stage.serial_s for stage in self.stages) - hidden

    def seconds(self, cores: int) -> float:
        """Returns how long the job takes on so many cores."""
        saved = 0.0
        for behind, before in self.beside:
            apart = behind.seconds(cores), before.seconds(cores)
            saved += sum(apart) - max(*apart, (behind.cpu_s + before.cpu_s) / cores)
        return sum(stage.seconds(cores) for stage in self.stages) - saved

    def loops(self) -> dict[str, list[Loop]]:
        """Returns the outer loops by name."""
        named: dict[str, list[Loop]] = defaultdict(list)
        for loop in (loop for stage in self.stages for loop in stage.loops):
            named[loop.name].append(loop)
        return dict(named)


def schedule(seconds: Sequence[float], cores: int) -> float:
    """Schedules pieces of work, each on the core that is free first, in their order. Returns the time at which the last
    one ends."""
    free = [0.0] * cores
    for duration in seconds:
        heapq.heapreplace(free, free[0] + duration)
    return max(free)


def work_of(document: Mapping[str, Any]) -> JobWork:
    """Reads the work of a job from a trace's document. Raises ValueError for another format."""
    if document.get("format") != FORMAT:
        raise ValueError(f"format {document.get('format')!r} for {FORMAT!r}")
    spans = [event for event in document["traceEvents"] if event["ph"] == "X"]
    stages = {"start": Section("start", document["before_cpu_s"])}
    parts: dict[str, Section] = {}
    beside: dict[str, list[Section]] = {"background": [], "foreground": []}
    regions: dict[int, Section] = {}
    loops = {span["args"]["loop"]: _loop(span) for span in spans if span["cat"] == "loop"}
    slices: dict[int, Slice] = {}
    between_s = 0.0
    for span, around in _nested(spans):
        name, kind, arguments = span["name"], span["cat"], span["args"]
        stage = next((outer["name"] for outer in around if outer["cat"] == "stage"), None)
        if kind == "job":
            between_s += arguments["process_cpu_s"]
        elif kind == "stage":
            stages.setdefault(name, Section(name)).cpu_s += arguments["process_cpu_s"]
            between_s -= arguments["process_cpu_s"]
        elif kind in beside:
            regions[id(span)] = Section(name, arguments["process_cpu_s"])
            beside[kind].append(regions[id(span)])
        elif kind == "part":
            if not any(outer["cat"] == "slice" for outer in around):
                parts.setdefault(f"{stage}: {name}", Section(f"{stage}: {name}")).cpu_s += arguments["process_cpu_s"]
        elif kind == "slice":
            slices[id(span)] = Slice(arguments.get("first", len(slices)), arguments["cpu_s"])
            loops[arguments["loop"]].slices.append(slices[id(span)])
            holder = next((outer for outer in reversed(around) if outer["cat"] == "slice"), None)
            if holder is not None:  # a loop's within a loop's, both on this thread
                slices[id(holder)].serial_s -= arguments["cpu_s"]
        elif kind == "loop":
            loop = loops[arguments["loop"]]
            holder = next((outer for outer in reversed(around) if outer["cat"] == "slice"), None)
            if holder is not None:
                slices[id(holder)].loops.append(loop)
                continue
            if stage is not None:
                stages[stage].loops.append(loop)
            for outer in around:
                if outer["cat"] == "part":
                    parts[f"{stage}: {outer['name']}"].loops.append(loop)
                elif id(outer) in regions:
                    regions[id(outer)].loops.append(loop)
    pairs = tuple(zip(beside["background"], beside["foreground"], strict=True))
    return JobWork((*stages.values(), Section("between", max(0.0, between_s))), tuple(parts.values()), pairs)


def _loop(span: Mapping[str, Any]) -> Loop:
    return Loop(span["name"], span["args"]["count"], span["args"]["single"])


def _nested(spans: Sequence[Mapping[str, Any]]) -> Iterator[tuple[Mapping[str, Any], list[Mapping[str, Any]]]]:
    """Every span, after those of its thread that hold it, with these, the outermost first."""
    threads: dict[int, list[Mapping[str, Any]]] = defaultdict(list)
    for span in spans:
        threads[span["tid"]].append(span)
    for own_thread in threads.values():
        around: list[Mapping[str, Any]] = []
        for span in sorted(own_thread, key=lambda event: (event["ts"], -event["dur"])):
            while around and _end(span) > _end(around[-1]):
                around.pop()
            yield span, around
            around.append(span)


def _end(span: Mapping[str, Any]) -> int:
    return round(1000 * span["ts"]) + round(1000 * span["dur"])  # nanoseconds, so that nothing is rounded apart
