"""A run while files of it are saved for a client."""

from sehdr_warp import load_run
from sehdr_warp.viewer.clients import ClientRun
from sehdr_warp.viewer.viewer_scene import ViewerScene


def test_a_small_save_that_is_averaged_waits_as_a_picture_of_its_finer_pixels(embedded_run):
    run, sizes = load_run(embedded_run), []

    def on_renderer(client, make, pixels):
        sizes.append(pixels)
        return make()

    client_run, photo = ClientRun(on_renderer, ViewerScene(run, "run"), None), run.cameras[0].camera
    small = photo.resized(photo.width // 2, photo.height // 2)
    for supersample in (True, False):
        assert client_run.render(small, supersample=supersample).hdr.shape == (small.height, small.width, 3)
    assert sizes == [4 * small.width * small.height, small.width * small.height]
