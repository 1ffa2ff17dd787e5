"""Matches SIFT keypoints between photographs that show the same points of the scene, with pycolmap on the CPU.

Shots of one rig share its cameras but not the scene, because heads move between shots. Photographs are therefore
matched only within each shot. The keypoints of all shots of a camera are then merged into one image, so that structure
from motion gives one pose for the camera. All steps of the matching run in one thread with one seed. With more threads,
the order of RANSAC's random draws, and so the result, would depend on the scheduler.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from calibration.scene.photographs import ONE_SHOT, Photographs
from rig.errors import InputError
from rig.formats.pictures.images import decode_image_file, write_image
from rig.messages.message import Message, compose
from rig.progress import Progress

SEED = 0
LENS_MODEL = "RADIAL"  # f cx cy k1 k2: what one picture, or a few of one lens, can carry
FEATURES_MOST = 3500  # a picture
PEAK_LEAST = 0.002  # contrast of a keypoint; COLMAP's own 0.0067 leaves 600 of 3,100 on a face, and its views apart
SIDE_MOST_PX = 2400  # features are found in pictures no larger; they are placed to a tenth of a pixel anyhow


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Holds COLMAP databases of the matches between photographs. A database has one image for each camera.

    Attributes:
        databases: the first has one lens for all images if these have one size; the last has a lens for each image,
            unless ``one_lens``.
        one_lens: whether all photographs were taken with one camera at one setting.
        sizes: width and height of each camera's photographs, px.
        features: number of keypoints by camera.
        matched: number of verified matches by pair of cameras.
        matched_keypoints: number of keypoints that have a match.
    """

    databases: tuple[Path, ...]
    one_lens: bool
    sizes: dict[str, tuple[int, int]]
    features: dict[str, int]
    matched: dict[tuple[str, str], int]
    matched_keypoints: int


def match_photographs(photographs: Photographs, scratch: Path, *, one_lens: bool | None, report: Progress) -> Matches:
    """Finds keypoints in all photographs, matches them within each shot, and verifies the matches by two-view geometry.

    Args:
        photographs: by camera and shot.
        scratch: folder of the caller, which may be deleted once the structure is solved.
        one_lens: whether all photographs were taken with one camera at one setting; None assumes so if each camera has
            one picture and all have one size.
        report: progress.

    Raises an InputError that names every unusable picture.
    """
    sizes = _write_grey(photographs, scratch / "pictures")
    if one_lens is None:
        one_lens = len(set(sizes.values())) == 1 and photographs.shots == (ONE_SHOT,)
    elif one_lens and len(set(sizes.values())) > 1:
        raise InputError("photographs", [compose("photographs-of-sizes", sizes=len(set(sizes.values())))])
    with quiet():
        _extract(photographs, scratch, report)
        _match_shots(photographs, scratch, report)
        report("matches", 0.8)
        databases = tuple(
            _merge(photographs, scratch, f"lens-{mode}", one_lens=mode == "one")
            for mode in ("one", "each")
            if (mode == "one" and len(set(sizes.values())) == 1) or (mode == "each" and not one_lens)
        )
    return _matches(databases, sizes, one_lens=one_lens)


@contextmanager
def quiet() -> Iterator[None]:
    """Switches off COLMAP's log within the ``with`` block, because users do not need it."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _write_grey(photographs: Photographs, folder: Path) -> dict[str, tuple[int, int]]:
    """Decodes pictures and writes them in grey, because COLMAP would decode differently. Returns sizes (px)."""

    def one(job: tuple[str, str, Path]) -> tuple[tuple[int, int], Message | None]:
        camera, shot, path = job
        where = f"{path.parent.name}/{path.name}"
        pixels, _, fault = decode_image_file(path, where, "grey")
        if pixels is None:
            return (0, 0), fault
        target = folder / camera / f"{shot}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_image(target, pixels)
        return (pixels.shape[1], pixels.shape[0]), None

    jobs = [(camera, shot, path) for camera, files in photographs.files.items() for shot, path in files.items()]
    with ThreadPoolExecutor(max_workers=4) as pool:
        done = list(pool.map(one, jobs))
    faults: list[Message] = [fault for _, fault in done if fault]
    sizes: dict[str, tuple[int, int]] = {}
    for (camera, shot, _), (size, fault) in zip(jobs, done, strict=True):
        if not fault and sizes.setdefault(camera, size) != size:
            wanted = " x ".join(map(str, sizes[camera]))
            faults.append(
                compose(
                    "photograph-size-differs",
                    camera=camera,
                    shot=shot,
                    width=size[0],
                    height=size[1],
                    wanted=str(wanted),
                )
            )
    if faults:
        raise InputError("photographs", faults)
    return sizes


def _extract(photographs: Photographs, scratch: Path, report: Progress) -> None:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu, options.max_image_size = 1, False, SIDE_MOST_PX
    options.sift.max_num_features, options.sift.peak_threshold = FEATURES_MOST, PEAK_LEAST
    files = [f"{camera}/{shot}.png" for camera, shots in photographs.files.items() for shot in shots]
    for number, file in enumerate(files):
        report("features", number / len(files))
        pycolmap.set_random_seed(SEED)
        pycolmap.extract_features(
            scratch / "shots.db",
            scratch / "pictures",
            [file],
            pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )


def _match_shots(photographs: Photographs, scratch: Path, report: Progress) -> None:
    import pycolmap

    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu, options.skip_geometric_verification = 1, False, True
    for number, shot in enumerate(photographs.shots):
        report("matches", 0.8 * number / len(photographs.shots))
        files = [f"{camera}/{shot}.png" for camera, shots in photographs.files.items() if shot in shots]
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = _pairs_file(scratch / "shot.pairs", combinations(files, 2))
        pycolmap.match_image_pairs(
            scratch / "shots.db", options, pairing, pycolmap.TwoViewGeometryOptions(), pycolmap.Device.cpu
        )


def _pairs_file(path: Path, pairs: Iterator[tuple[str, str]]) -> Path:
    path.write_text("".join(f"{one} {other}\n" for one, other in pairs), encoding="utf-8")
    return path


def _first(photographs: Photographs) -> list[str]:
    """Returns the name of the picture that represents each camera in COLMAP's database."""
    return [f"{camera}/{next(iter(shots))}.png" for camera, shots in photographs.files.items()]


def _merge(photographs: Photographs, scratch: Path, name: str, *, one_lens: bool) -> Path:
    """Merges the keypoints of all shots of a camera into one image, then renumbers and verifies the matches."""
    import pycolmap

    options = pycolmap.ImageReaderOptions()
    options.camera_model = LENS_MODEL
    mode = pycolmap.CameraMode.SINGLE if one_lens else pycolmap.CameraMode.PER_IMAGE
    pycolmap.Database.open(path := scratch / f"{name}.db").close()  # it imports into a file that exists
    pycolmap.import_images(path, scratch / "pictures", mode, _first(photographs), options)
    shots, cameras = pycolmap.Database.open(scratch / "shots.db"), pycolmap.Database.open(path)
    try:
        source = {image.name: image.image_id for image in shots.read_all_images()}
        target = {Path(image.name).parts[0]: image.image_id for image in cameras.read_all_images()}
        first: dict[tuple[str, str], int] = {}
        for camera, camera_shots in photographs.files.items():
            keypoints = [shots.read_keypoints(source[f"{camera}/{shot}.png"])[:, :2] for shot in camera_shots]
            starts = np.cumsum([0, *map(len, keypoints)])
            first.update({(camera, shot): int(start) for shot, start in zip(camera_shots, starts, strict=False)})
            cameras.write_keypoints(target[camera], np.concatenate(keypoints))
        for one, other in combinations(photographs.files, 2):
            found = []
            for shot in photographs.files[one].keys() & photographs.files[other].keys():
                pair = (source[f"{name}/{shot}.png"] for name in (one, other))
                matches = shots.read_matches(*pair).astype(np.int64)
                found.append(matches.reshape(-1, 2) + [first[one, shot], first[other, shot]])
            joined = np.concatenate(found) if found else np.zeros((0, 2), np.int64)
            cameras.write_matches(target[one], target[other], joined.astype(np.uint32))
    finally:
        shots.close()
        cameras.close()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.set_random_seed(SEED)
    pycolmap.verify_matches(
        path, _pairs_file(scratch / "cameras.pairs", combinations(_first(photographs), 2)), verification
    )
    return path


def _matches(databases: tuple[Path, ...], sizes: dict[str, tuple[int, int]], *, one_lens: bool) -> Matches:
    import pycolmap

    database = pycolmap.Database.open(databases[-1])
    try:
        names = {image.image_id: Path(image.name).parts[0] for image in database.read_all_images()}
        features = {name: database.num_keypoints_for_image(image) for image, name in names.items()}
        matched: dict[tuple[str, str], int] = {}
        keypoints: set[tuple[int, int]] = set()
        pairs, geometries = database.read_two_view_geometries()
        for pair, geometry in zip(pairs, geometries, strict=True):
            images = pycolmap.pair_id_to_image_pair(pair)
            matched[names[images[0]], names[images[1]]] = len(geometry.inlier_matches)
            for side, image in enumerate(images):
                keypoints |= {(image, int(index)) for index in geometry.inlier_matches[:, side]}
    finally:
        database.close()
    return Matches(databases, one_lens, sizes, features, matched, len(keypoints))
