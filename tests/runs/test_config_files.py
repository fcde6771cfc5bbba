"""Presets are what their methods say."""

from sehdr_warp.runs.config_files import load_config, override_config, preset_names


def test_presets_are_what_their_methods_say():
    gs, truth, with_truth = (load_config(name) for name in ("hdr-gs", "truth", "hdr-gs-truth"))
    assert (gs.model.radiance, gs.model.tone_map, gs.response.name) == ("log", "gaussian", "learned")
    assert (gs.optimizer.response, gs.loss.form, gs.loss.ssim_weight, gs.loss.clipping) == (5e-4, "blend", 0.2, False)
    assert (gs.loss.ldr_weight, gs.loss.hdr_weight) == (1.0, 0.0) and not gs.loss.uses_hdr
    assert with_truth == override_config(gs, {"loss.hdr_weight": 0.6})
    assert load_config("gauss-hdr") == override_config(gs, {"model.tone_map": "pixel", "loss.anchor_weight": 0.5})
    assert (truth.loss.ldr_weight, truth.loss.hdr_weight) == (0.0, 1.0)
    assert load_config("paper-truth") == override_config(load_config("paper"), {"loss.hdr_truth": True})
    plans = {name for name in preset_names() if load_config(name).plan.enabled}
    assert plans == {"default", "fast", "demo"}
