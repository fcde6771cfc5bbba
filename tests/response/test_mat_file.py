"""MATLAB files: the same numbers as scipy reads, and damaged ones refused without ending the process."""

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from sehdr_warp.response.mat_file import read_matrices


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.uint8, np.int16])
def test_same_numbers_as_scipy(tmp_path, compressed, kind):
    values = (np.arange(15).reshape(3, 5) * 7).astype(kind)
    wanted = {"B": values, "I": values.T[:1] + 1, "text": "a", "cell": np.array([1, "x"], object), "x": np.eye(2) * 1j}
    savemat(tmp_path / "a.mat", wanted, do_compression=compressed)
    found = read_matrices(tmp_path / "a.mat", ("B", "I", "absent"))
    stored = loadmat(tmp_path / "a.mat")
    assert set(found) == {"B", "I"}
    for name, matrix in found.items():
        np.testing.assert_array_equal(matrix, stored[name])
    for name in ("text", "cell", "x"):
        with pytest.raises(ValueError, match=f"{name} is no matrix of real numbers"):
            read_matrices(tmp_path / "a.mat", (name,))


def test_damaged_files_are_refused(tmp_path):
    """scipy's loadmat dies of some of these."""
    path = tmp_path / "a.mat"
    savemat(path, {"B": np.eye(4), "I": np.eye(4)})
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(500):
        data = bytearray(whole)
        data[rng.integers(128, len(data))] = rng.choice([0, 1, 0x7F, 0x80, 0xFF])
        path.write_bytes(data[: rng.integers(100, len(data) + 1)])
        try:
            found = read_matrices(path, ("B", "I"))
        except ValueError:
            refused += 1
        else:
            assert all(matrix.nbytes < 10_000 for matrix in found.values())
    assert refused > 100


def test_published_file_as_scipy_reads_it(shared):
    path = shared / "crf" / "201_CRF_data.mat"
    found, stored = read_matrices(path, ("B", "I")), loadmat(path)
    for name in ("B", "I"):
        np.testing.assert_array_equal(found[name], stored[name])
