"""Frames in parts."""

from ..output.helpers import AnalyticRun, camera


def test_a_scene_that_is_replaced_within_a_frame(serve):
    shown = serve().viewer.runs[0]
    parts = shown.frame_parts(camera(12, 8), clipped=True)
    assert next(parts) is None
    shown.replace(AnalyticRun(), None)
    made = [*parts][-1]
    assert made.nbytes == 12 * 8 * 5 * 2 and made == shown.frame(camera(12, 8))
