"""Edges, codes and bands that are evidence of a response."""

import numpy as np
import pytest

from sehdr_warp.response.selection_evidence import collect_evidence

from .mosaics import mosaic, photograph


def test_edges_are_colors_of_two_tiles_and_their_mixture():
    light = mosaic()[5:6].repeat(96, axis=0)  # Stripes
    edges = collect_evidence([photograph("linear", light)], 0).edges
    assert len(edges) >= 5 * 96 and len(edges) % 96 == 0, "of 7 or 8 boundaries"
    sides = edges[:, ::2].reshape(-1, 1, 3)
    assert np.abs(sides - light[0, 5::12]).max(2).min(1).max() <= 0.5 / 255 + 1e-9
    first, middle, last = edges.swapaxes(0, 1)
    share = ((middle - first) * (last - first)).sum(1) / np.square(last - first).sum(1)
    np.testing.assert_allclose(middle, first + share[:, None] * (last - first), atol=1.2 / 255)
    np.testing.assert_allclose(share, share.round(2).mean(), atol=0.02)


def test_gray_flat_and_clipped_pictures_have_no_edges():
    gray = mosaic()[..., :1] * np.ones(3)
    for light in (gray, np.full((32, 32, 3), 0.3), np.ones((3, 3, 3)), 1e3 * mosaic()):
        assert len(collect_evidence([photograph("srgb", light)], 0).edges) == 0


def test_arrays_and_codes_are_the_same_evidence():
    photo = photograph("srgb", mosaic())
    expected = collect_evidence([photo], 0)
    for codes in (np.rint(photo * 255).astype(np.uint8), np.rint(photo * 65535).astype(np.uint16)):
        evidence = collect_evidence([codes], 0)
        np.testing.assert_allclose(evidence.edges, expected.edges, atol=1e-9)
        np.testing.assert_array_equal(evidence.shares, expected.shares)
    assert expected.shares.sum() == pytest.approx(1)


def test_large_photos_are_read_in_bands_over_their_height():
    dark = np.zeros((1600, 400, 3), np.uint8)
    dark[:800] = 128
    evidence = collect_evidence([dark, dark[:16]], 0)
    assert len(evidence.clearest) > 10 and {band.encoded.shape for band in evidence.clearest} == {(32, 400, 3)}
    assert evidence.clear_pixels == sum(band.clear.sum() for band in evidence.clearest)
    assert evidence.shares[128] == pytest.approx(0.5, abs=0.05)
