"""Presets and files of configs: read, written, overridden, and refused in a line."""

import json

import pytest

from sehdr_warp.errors import InputError
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
    problem = "config.json: loss.clipped_lift = 0.5 is of an earlier version and was removed; it gained nothing"
    with pytest.raises(InputError, match=problem):
        config_from_dict(values, tmp_path / "config.json")
    values["loss"]["clipped_lift"] = 0.0
    assert config_from_dict(values) == Config() and values["mcmc"]["prune_near_angle"] == 0.0


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
    ("arguments", "message"),
    [
        ((None,), "preset is None, expected a path, as text or pathlib.Path"),
        ((["demo"],), r"preset is \['demo'\], expected a path"),
        (({"seed": 1},), r"preset is \{'seed': 1\}, expected a name or a file; pass fields as overrides"),
        (("demo", ["seed"]), r"overrides is \['seed'\], expected a dict of field names and values"),
        (("demo", "seed=1"), "overrides is 'seed=1', expected a dict of field names and values"),
    ],
)
def test_arguments_of_another_type_are_named(arguments, message):
    with pytest.raises(TypeError, match=message):
        load_config(*arguments)
