"""Archives and pickles give their arrays back and run nothing; damaged and foreign ones are refused in a sentence."""

import io
import os
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sparse

from rig.errors import InputError
from rig.formats.meshes import pickled_arrays
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz, read_pickled_arrays


class Runs:
    """Makes a file while it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., int], tuple[str]]:
        return os.system, (f"touch {self.path}",)


def written(folder: Path, content: object, protocol: int = 2) -> Path:
    path = folder / "model.pkl"
    path.write_bytes(pickle.dumps(content, protocol))
    return path


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_arrays_come_back_as_they_were(tmp_path: Path, protocol: int) -> None:
    whole = {
        "turned": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        "big-endian": np.arange(5, dtype=">i4"),
        "empty": np.zeros((0, 3), np.float32),
        "bs_style": "lbs",
    }
    found = read_pickled_arrays(written(tmp_path, whole, protocol))
    assert sorted(found) == ["big-endian", "empty", "turned"]
    for name, array in found.items():
        np.testing.assert_array_equal(array, whole[name])


@pytest.mark.parametrize("make", [sparse.csc_matrix, sparse.csr_matrix])
def test_sparse_matrices_become_dense(tmp_path: Path, make: Callable[[np.ndarray], object]) -> None:
    dense = np.eye(4, 6) * 0.25
    np.testing.assert_array_equal(read_pickled_arrays(written(tmp_path, {"J": make(dense)}))["J"], dense)


def test_nothing_that_a_pickle_names_is_run(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    with pytest.raises(InputError, match="system"):
        read_pickled_arrays(written(tmp_path, {"v": np.zeros(3), "x": Runs(mark)}))
    assert not mark.exists()
    with pytest.raises(InputError, match="no dictionary of arrays"):
        read_pickled_arrays(written(tmp_path, {"v": Claims()}))


class Claims:
    """Pickles as an array whose buffer is a number, which ``bytes`` would take for a size."""

    def __reduce__(self) -> tuple[object, ...]:
        made, arguments, _ = np.zeros(3).__reduce__()
        return made, arguments, (1, (3,), np.dtype(float), False, 1 << 40)


@pytest.mark.parametrize("content", [[1, 2], {}, {"name": "nothing but words"}, np.zeros(3)])
def test_a_pickle_without_arrays_by_name_is_refused(tmp_path: Path, content: object) -> None:
    with pytest.raises(InputError):
        read_pickled_arrays(written(tmp_path, content))


def test_a_torn_pickle_is_refused_wherever_it_is_torn(tmp_path: Path) -> None:
    path = written(tmp_path, {"v": np.arange(6.0)})
    data = path.read_bytes()
    for end in range(len(data)):
        path.write_bytes(data[:end])
        with pytest.raises(InputError):
            read_pickled_arrays(path)


def test_an_archive_that_lies_about_its_arrays_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An array of 8 TB of which no byte is there, and more zeros than are wanted in a small file."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    path = tmp_path / "lie.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mean.npy", header.getvalue() + bytes(64))
    with pytest.raises(DAMAGE), open_npz(path) as file:
        file["mean"]
    np.savez_compressed(tmp_path / "zeros.npz", mean=np.zeros(200_000))
    monkeypatch.setattr(pickled_arrays, "MAX_UNPACKED", 1 << 20)
    with pytest.raises(ValueError, match="more than 1 MB"), open_npz(tmp_path / "zeros.npz"):
        pass


def test_a_damaged_archive_raises_what_its_readers_expect(tmp_path: Path) -> None:
    path, rng = tmp_path / "arrays.npz", random.Random(7)
    np.savez_compressed(path, mean=np.arange(12.0), names=np.array(["a", "b"]))
    whole = path.read_bytes()
    for _ in range(500):
        data = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.choice([len(data), rng.randrange(len(data))])])
        try:
            with open_npz(path) as file:
                assert all(isinstance(file[name], np.ndarray) for name in file)
        except (OSError, *DAMAGE):
            continue
