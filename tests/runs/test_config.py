"""Configs: presets, files, overrides, and clear refusals."""

import copy
import pickle
from pathlib import Path

import pytest

import sehdr_warp
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import config_fields, load_config, preset_names
from sehdr_warp.training.optimizer import means_rate

PACKAGE = Path(sehdr_warp.__file__).parent


def test_paper_preset_is_the_papers():
    config = load_config("paper")
    assert config.fusion.enabled and config.fusion.exposures == ("1/8x", "1/4x", "1x", "8x", "16x")
    assert (config.loss.linear_weight, config.loss.form) == (0.5, "sum")
    assert (config.model.radiance, config.model.tone_map) == ("linear", "gaussian")


@pytest.mark.parametrize("name", preset_names())
def test_presets_keep_the_densification_of_their_method(name):
    """The default's mcmc goes with its weights on opacities and sizes; what builds on 3DGS has none of them."""
    config = load_config(name)
    strategy_fields = config.densification.strategy, config.loss.opacity_weight, config.loss.size_weight
    relocates = name in ("default", "fast", "demo", "truth")
    assert strategy_fields == (("mcmc", 0.01, 0.01) if relocates else ("adc", 0.0, 0.0))


def test_every_field_is_documented_and_read():
    # In config.py only what follows the declarations counts as reading.
    files = [path for package in ("runs", "training", "model") for path in (PACKAGE / package).rglob("*.py")]
    source = "".join(path.read_text().split("    def scaled")[-1] for path in files)
    assert "getattr(config.optimizer, name)" in source
    for path, item in config_fields():
        table, _, name = path.rpartition(".")
        assert item.description, path
        assert table == "optimizer" or f".{name}" in source or f'"{name}"' in source, f"{path} is never read"


def test_a_run_loads_although_its_config_has_a_wrong_name_in_plan_keep():
    assert load_config("default", {"plan.keep": ("mcmc.cap_densty",), "plan.enabled": False}).plan.keep


def test_every_number_has_a_smallest_and_a_largest_value():
    """A file may hold any: 10^400 is no float, and none has so many Gaussians."""
    schema = Config.model_json_schema()
    for part in (schema, *schema["$defs"].values()):
        for name, field in part["properties"].items():
            field = field.get("items", field)
            if field.get("type") in ("integer", "number"):
                assert {"minimum", "exclusiveMinimum"} & field.keys(), name
                assert {"maximum", "exclusiveMaximum"} & field.keys(), name


@pytest.mark.parametrize(
    "fields,words",
    [
        ({"loss.linear_weight": 0.5}, "nothing to compare"),
        ({"loss.ldr_weight": 0.0}, "nothing to compare"),
        ({"model.radiance": "display", "fusion.enabled": True}, "fusion.enabled = True needs radiance"),
        ({"model.radiance": "display", "loss.hdr_weight": 1.0}, r"loss.hdr_weight = 1\.0 needs radiance"),
        ({"fusion.enabled": True, "fusion.exposures": ["1x"]}, "two or more"),
        ({"fusion.exposures": ["1/8x", "1x", "1/8x"]}, "1/8x more than once"),
        ({"response.name": "learned", "fusion.enabled": True}, "fusion.enabled = .* needs a known response"),
        ({"response.name": "learned", "model.radiance": "display"}, "model.radiance = .* needs a known response"),
        ({"loss.anchor_weight": 0.5}, r'anchor_weight = 0\.5 has no effect: needs response.name = "learned"'),
    ],
)
def test_contradictions_are_refused(fields, words):
    with pytest.raises(InputError, match=words):
        load_config("default", fields)


def test_iteration_numbers_scale():
    config = load_config("default", {"schedule.iterations": 3000})
    assert config.scaled(15_000) == 1500 and config.scaled(1) == 1
    assert config.scaled(700) == 70


def test_a_finished_training_goes_on_with_its_harmonics_and_positions_that_learn_slowly():
    finished, longer = load_config("default"), load_config("default", {"schedule.iterations": 90_000})
    after = longer.continued_after(30_000)
    assert after.scaled(after.densification.refine_stop_iter) <= 30_000 and after.degree_at(30_001) == 3
    rates = finished.optimizer
    assert means_rate(after, 30_000) == pytest.approx(10 * rates.means_final)
    assert means_rate(after, 90_000) == pytest.approx(rates.means_final)
    twice = load_config("default", {"schedule.iterations": 60_000})
    assert means_rate(twice.continued_after(30_000), 30_001) == pytest.approx(means_rate(twice, 30_001))
    assert longer.continued_after(0) == longer and longer.continued_after(90_000) == longer
    assert longer.continued_after(29_000) == longer  # After a trial, densification begins again.


def test_a_field_cannot_be_set_and_the_error_says_what_to_do():
    config = load_config("default")
    with pytest.raises(SehdrError, match=r"LossConfig.ssim_weight = 3: a config cannot be changed; .*load_config\("):
        config.loss.ssim_weight = 3
    assert pickle.loads(pickle.dumps(config)) == config == copy.deepcopy(config)
