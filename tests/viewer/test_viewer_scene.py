"""Frames in parts."""

from ..output.helpers import AnalyticRun, camera


def test_a_scene_that_is_replaced_within_a_frame(serve):
    viewer_scene = serve().viewer.runs[0]
    parts = viewer_scene.frame_parts(camera(12, 8), clipped=True)
    assert next(parts) is None
    viewer_scene.replace(AnalyticRun(), None)
    answer = [*parts][-1]
    assert answer.nbytes == 12 * 8 * 5 * 2 and answer == [*viewer_scene.frame_parts(camera(12, 8))][-1]
