"""Configs: presets, files, overrides, and clear refusals."""

import json
import textwrap
from pathlib import Path

import pytest
from pydantic import BaseModel, ValidationError

import sehdr_warp
from sehdr_warp.errors import InputError
from sehdr_warp.training.config import Config, FusionConfig, LossConfig, ModelConfig, ResponseConfig, stated
from sehdr_warp.training.config_checks import ConfigError
from sehdr_warp.training.config_files import (
    config_from_dict,
    config_to_dict,
    load_config,
    override_config,
    preset_names,
)

PACKAGE = Path(sehdr_warp.__file__).parent


def leaves(node=None, prefix=""):
    node = Config() if node is None else node
    for name, item in type(node).model_fields.items():
        value = getattr(node, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, item


def test_presets_that_ship():
    assert {"default", "paper", "fast", "demo", "3dgs"} <= set(preset_names())


@pytest.mark.parametrize("name", preset_names())
def test_preset_loads_and_survives_json(name):
    config = load_config(name)
    assert config_from_dict(json.loads(json.dumps(config_to_dict(config)))) == config


def as_toml(config):
    """A commented TOML file that states every field of a config."""

    def lines_of(node):
        for name, item in type(node).model_fields.items():
            value = getattr(node, name)
            if not isinstance(value, BaseModel):
                text = item.description.replace("\n", " ")
                yield from textwrap.wrap(text, 116, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
                # JSON's strings, numbers, booleans and lists are TOML's as well.
                yield f"{name} = {json.dumps(value)}"

    lines = list(lines_of(config))
    for name, value in config:
        if isinstance(value, BaseModel):
            lines += [f"\n[{name}]", *lines_of(value)]
    return "\n".join(lines) + "\n"


def test_default_preset_states_every_field_with_its_meaning():
    text = (PACKAGE.parent / "configs" / "default.toml").read_text()
    assert text.endswith(as_toml(Config())), "write configs/default.toml again with as_toml(Config())"
    assert load_config("default") == Config()


def test_paper_preset_is_the_papers():
    config = load_config("paper")
    assert config.fusion.enabled and config.fusion.exposures == ("1/8x", "1/4x", "1x", "8x", "16x")
    assert (config.loss.linear_weight, config.loss.form) == (0.5, "sum")
    assert (config.model.radiance, config.model.tone_map) == ("linear", "gaussian")


@pytest.mark.parametrize("name", preset_names())
def test_presets_keep_the_densification_of_their_method(name):
    """The default's relocation goes with its opacity weight; what builds on 3DGS or is short has neither."""
    config = load_config(name)
    found = config.densification.strategy, config.loss.opacity_weight
    relocates = name in ("default", "truth", "predicted")
    assert found == (("relocation", 0.01) if relocates else ("gradient", 0.0))


@pytest.mark.parametrize("path,item", list(leaves()), ids=[path for path, _ in leaves()])
def test_every_field_is_documented_and_read(path, item):
    assert item.description
    name = path.split(".")[-1]
    names = [f".{name}", f'"{name}"']
    if path.startswith("optimizer."):
        names.append("getattr(config.optimizer, name)")
    # In config.py only what follows the declarations counts as reading.
    sources = [
        p.read_text().split("    def scaled")[-1]
        for room in ("training", "field")
        for p in (PACKAGE / room).glob("*.py")
    ]
    assert any(name in source for source in sources for name in names), f"{path} is never read"


@pytest.mark.parametrize(
    "text,words",
    [
        ("[model]\nopacity = 0.2", ["model.opacity", "0.2", "unknown"]),
        ("[model]\nradiance2 = 1", ["model.radiance2 = 1", "did you mean model.radiance?"]),
        ("[schedule]\niterations = 0", ["schedule.iterations = 0", "greater than or equal to 1"]),
        ("[schedule]\niterations = 1.5", ["schedule.iterations = 1.5", "int"]),
        ("[loss]\nssim_weight = nan", ["loss.ssim_weight = nan", "finite"]),
        ("[model]\nradiance = 'rgb'", ["model.radiance = 'rgb'", "log"]),
        ("[model]\nantialiased = 1", ["model.antialiased = 1", "bool"]),
        ("[fusion]\nexposures = '1'", ["fusion.exposures", "tuple"]),
        ("[schedule]\nevaluate_at = [0]", ["schedule.evaluate_at = 0"]),
        ("model = 3", ["model = 3", "dictionary"]),
        ("[model", ["TOML"]),
        ("base = 'own.toml'", ["bases"]),
        ("base = 7", ["base = 7"]),
    ],
)
def test_bad_files_name_file_field_and_value(tmp_path, text, words):
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_config(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    for word in words:
        assert word in message


def test_missing_preset_is_refused():
    with pytest.raises(InputError, match="default, demo"):
        load_config("defualt")


def test_base_and_overrides(tmp_path):
    (tmp_path / "base.toml").write_text("base = 'paper'\nseed = 4\n[loss]\nssim_weight = 0.3")
    (tmp_path / "own.toml").write_text("base = 'base.toml'\n[loss]\nlinear_weight = 0.25")
    config = load_config(tmp_path / "own.toml", {"schedule.iterations": 12})
    assert (config.seed, config.loss.ssim_weight, config.loss.linear_weight) == (4, 0.3, 0.25)
    assert config.fusion.enabled and config.schedule.iterations == 12
    assert override_config(config, {"seed": 9}).seed == 9
    with pytest.raises(InputError, match="seed = -1"):
        override_config(config, {"seed": -1})


def test_contradictions_are_refused():
    with pytest.raises(ConfigError, match="nothing to compare"):
        Config(loss=LossConfig(linear_weight=0.5))
    with pytest.raises(ConfigError, match="display"):
        Config(model=ModelConfig(radiance="display"), fusion=FusionConfig(enabled=True))
    with pytest.raises(ConfigError, match="two or more"):
        Config(fusion=FusionConfig(enabled=True, exposures=("1x",)))
    with pytest.raises(ConfigError, match="learned"):
        Config(response=ResponseConfig(name="learned"), fusion=FusionConfig(enabled=True))


def test_iteration_numbers_scale():
    config = load_config("default", {"schedule.iterations": 3000})
    assert config.scaled(15_000) == 1500 and config.scaled(1) == 1
    assert config.scaled(stated(70, 3000)) == 70


def test_a_config_is_refused_before_it_is_made():
    with pytest.raises(ValidationError, match="ssim_weight"):
        LossConfig(ssim_weight=1.5)
    with pytest.raises(ValidationError, match="frozen"):
        Config().seed = 3
