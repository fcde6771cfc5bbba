"""Configs: presets, files, overrides, and clear refusals."""

import copy
import json
import pickle
from pathlib import Path

import pytest

import sehdr_warp
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import (
    GONE,
    RENAMED,
    config_as_toml,
    config_fields,
    config_from_dict,
    load_config,
    override_config,
    preset_names,
)
from sehdr_warp.runs.config_flags import parse_field
from sehdr_warp.training.optimizer import means_rate

PACKAGE = Path(sehdr_warp.__file__).parent


@pytest.mark.parametrize("name", preset_names())
def test_preset_loads_and_survives_json(name):
    config = load_config(name)
    assert config_from_dict(json.loads(json.dumps(config.model_dump()))) == config


def test_the_default_preset_is_the_defaults():
    assert load_config("default") == Config()


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("differing", [False, True])
def test_a_config_as_toml_is_read_back(name, differing, tmp_path):
    config = load_config(name)
    (tmp_path / "own.toml").write_text(config_as_toml(config, differing))
    assert load_config(tmp_path / "own.toml") == config


def test_any_letter_of_a_file_name_is_read_back(tmp_path):
    config = load_config("default", {"model.init_file": '\U0001f642 \u00e9\x7f"\\\n.ply'})
    (tmp_path / "own.toml").write_text(config_as_toml(config, True), encoding="ascii")
    assert load_config(tmp_path / "own.toml") == config


def test_what_differs_is_marked():
    lines = config_as_toml(load_config("default", {"loss.clipping": False})).splitlines()
    assert [line for line in lines if "default:" in line] == ["clipping = false  # default: true"]


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


@pytest.mark.parametrize(
    "text,words",
    [
        ("[model]\nopacity = 0.2", ["model.opacity", "0.2", "unknown"]),
        ("[densification]\nbudget = 9.0", ["budget = 9.0 has another name since version 0.3; write mcmc.cap_density"]),
        ("[densification]\nstrategy = 'relocation'", ["'relocation' has another name since version 0.3: 'mcmc'"]),
        ("[los]\nclipping = true", ["los.clipping = True", "did you mean loss.clipping?"]),
        ("[model]\nradiance2 = 1", ["model.radiance2 = 1", "did you mean model.radiance?"]),
        ("[schedule]\niterations = 0", ["schedule.iterations = 0", "greater than or equal to 1"]),
        ("[schedule]\ncheckpoint_every = 1" + "0" * 400, ["schedule.checkpoint_every", "less than or equal"]),
        ("[schedule]\niterations = 1.5", ["schedule.iterations = 1.5", "int"]),
        ("[loss]\nssim_weight = nan", ["loss.ssim_weight = nan", "finite"]),
        ("[model]\nradiance = 'rgb'", ["model.radiance = 'rgb'", "log"]),
        ("[model]\nantialiased = 1", ["model.antialiased = 1", "bool"]),
        ("[fusion]\nexposures = '1'", ["fusion.exposures", "tuple"]),
        ("[schedule]\nevaluate_at = [0]", ["schedule.evaluate_at = 0"]),
        ("[plan]\nkeep = ['seed', 'mcmc.cap_densty']", ["plan.keep has 'mcmc.cap_densty', which is not a field"]),
        ("[plan]\nkeep = ['mcmc']", ["plan.keep has 'mcmc', which is not a field"]),
        ("model = 3", ["model = 3", "dictionary"]),
        ("[model", ["TOML"]),
        ("base = 'own.toml'", ["bases"]),
        ("base = 7", ["base = 7"]),
        ("base = 'fastest'", ["fastest"]),
        ("[seed]\na = 1", ["seed"]),
        ("[optimizer]\nmeans = inf", ["optimizer.means"]),
        ("a = " + "[" * 100_000, []),
        (".".join("a" * 5000) + " = 1", []),
        ("\x80\x04\xff", []),
    ],
)
def test_bad_files_name_file_field_and_value(tmp_path, text, words):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError) as caught:
        load_config(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    for word in words:
        assert word in message


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


def test_missing_preset_is_refused():
    with pytest.raises(InputError, match=r"did you mean default\?; use one of 3dgs, default, demo"):
        load_config("defualt")


def test_an_override_is_blamed_by_its_flag_and_never_the_file():
    with pytest.raises(InputError, match=r"^--iterations: schedule.iterations = 0: "):
        load_config("fast", {"schedule.iterations": 0}, {"schedule.iterations": "--iterations"})
    with pytest.raises(InputError, match=r"^overrides: unknown field los.clipping = 1, did you mean loss.clipping\?"):
        load_config("fast", {"los.clipping": 1})
    with pytest.raises(InputError, match=r"^--loss.linear-weight: loss.linear_weight = 1.0 has nothing to compare"):
        load_config("default", {"loss.linear_weight": 1.0}, {"loss.linear_weight": "--loss.linear-weight"})
    with pytest.raises(InputError, match=r"unknown field fusion.enabled.x = 1, did you mean fusion.enabled\?"):
        load_config("paper", {"fusion.enabled.x": 1})


def test_a_gone_field_is_named_unless_it_was_off(tmp_path):
    """Runs and files of earlier versions hold all fields."""
    values = Config().model_dump()
    values["mcmc"]["prune_near_angle"], values["loss"]["clipped_lift"] = 0.0, 0.5
    problem = "config.json: loss.clipped_lift = 0.5 is of an earlier version and gone; it gained nothing"
    with pytest.raises(InputError, match=problem):
        config_from_dict(values, tmp_path / "config.json")
    values["loss"]["clipped_lift"] = 0.0
    assert config_from_dict(values) == Config() and values["mcmc"]["prune_near_angle"] == 0.0


@pytest.mark.parametrize(
    "path,text,value",
    [
        ("fusion.exposures", "1/8x, 1x", ("1/8x", "1x")),
        ("response.name", "201", "201"),
        ("schedule.evaluate_at", "100,200", (100, 200)),
        ("schedule.evaluate_at", "-1,2OO", (-1, "2OO")),
        ("loss.clipping", "false", False),
        ("loss.clipping", "perhaps", "perhaps"),
        ("optimizer.means", "1e-4", 1e-4),
        ("plan.keep", "", ()),
    ],
)
def test_values_of_flags(path, text, value):
    assert parse_field(path, text) == value


def test_no_field_is_both_here_and_gone():
    fields = {path for path, _ in config_fields()}
    assert not fields & (GONE.keys() | RENAMED.keys()) and set(RENAMED.values()) <= fields


def test_base_and_overrides(tmp_path):
    (tmp_path / "base.toml").write_text("base = 'paper'\nseed = 4\n[loss]\nssim_weight = 0.3")
    (tmp_path / "own.toml").write_text("base = 'base.toml'\n[loss]\nlinear_weight = 0.25")
    config = load_config(tmp_path / "own.toml", {"schedule.iterations": 12})
    assert (config.seed, config.loss.ssim_weight, config.loss.linear_weight) == (4, 0.3, 0.25)
    assert config.fusion.enabled and config.schedule.iterations == 12
    assert override_config(config, {"seed": 9}).seed == 9
    with pytest.raises(InputError, match="seed = -1"):
        override_config(config, {"seed": -1})


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
