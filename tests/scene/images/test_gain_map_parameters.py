"""Parameters of gain maps in XMP and ISO 21496-1."""

import logging
import time

import pytest

from sehdr_warp.scene.images.gain_map import read_gain_map
from sehdr_warp.scene.images.ldr_files import read_ldr

from .gain_map_files import STOPS, hdrgm, iso_metadata, pair, write_jpeg_pair


@pytest.mark.parametrize("segment", [
    (0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(STOPS)[:20]),
    (0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0\0\7" + iso_metadata(STOPS)[2:]),
    hdrgm(GainMapMax="nan"), hdrgm(GainMapMax="400"), hdrgm(Gamma="0"), hdrgm(GainMapMax="much"),
], ids=["cut", "version", "nan", "bright", "gamma", "word"])  # fmt: skip
def test_a_damaged_gain_map_is_named_and_the_photo_is_used(tmp_path, caplog, segment):
    _, base, gain = pair()
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [segment])
    with caplog.at_level(logging.WARNING, "sehdr_warp.scene"):
        assert read_gain_map(tmp_path / "a.jpg") is None
    assert "a.jpg: its gain map is damaged" in caplog.text
    assert read_ldr(tmp_path / "a.jpg").pixels.shape == base.shape


@pytest.mark.parametrize(
    "text", ["<hdrgm:a>", "<hdrgm:Gamma>", "<hdrgm:Gamma ", "hdrgm:Gamma=", "<rdf:li", "<hdrgm:" + "a" * 50]
)
def test_long_metadata_take_no_long_time(tmp_path, text):
    _, base, gain = pair()
    marker, body = hdrgm()
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [(marker, body + (text * (64000 // len(text))).encode()[:64000])])
    started = time.process_time()
    assert read_gain_map(tmp_path / "a.jpg") is not None
    assert time.process_time() - started < 1


def test_values_as_elements_and_sequences(tmp_path):
    _, base, gain = pair()
    listed = "".join(f"<rdf:li>{value}</rdf:li>" for value in (1.0, 2.0, 3.0))
    inner = f"<hdrgm:GainMapMax><rdf:Seq>{listed}</rdf:Seq></hdrgm:GainMapMax><hdrgm:Gamma>2</hdrgm:Gamma>"
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [(0xFFE1, b"http://ns.adobe.com/xap/1.0/\0" + inner.encode())])
    result = read_gain_map(tmp_path / "a.jpg").parameters
    assert result.maximum.tolist() == [1, 2, 3] and result.gamma.tolist() == [2, 2, 2]
