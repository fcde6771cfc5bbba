"""Configs: presets, files, overrides, and clear refusals."""

import json
import textwrap
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

import sehdr_warp
from sehdr_warp.errors import InputError
from sehdr_warp.training.config import Config, ConfigError, FusionConfig, LossConfig, ModelConfig
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
    for item in fields(node):
        value = getattr(node, item.name)
        if is_dataclass(value):
            yield from leaves(value, f"{prefix}{item.name}.")
        else:
            yield prefix + item.name, item


def test_presets_that_ship():
    assert {"default", "paper", "fast", "demo", "3dgs"} <= set(preset_names())


@pytest.mark.parametrize("name", preset_names())
def test_preset_loads_and_survives_json(name):
    config = load_config(name)
    assert config_from_dict(json.loads(json.dumps(config_to_dict(config)))) == config


def as_toml(config):
    """A commented TOML file that states every field of a config."""

    def stated(node, item):
        comment = textwrap.wrap(item.metadata["doc"], 116, initial_indent="# ", subsequent_indent="# ")
        # JSON's strings, numbers, booleans and lists are TOML's as well.
        return "\n".join([*comment, f"{item.name} = {json.dumps(getattr(node, item.name))}"])

    lines = [stated(config, item) for item in fields(config) if not is_dataclass(getattr(config, item.name))]
    for part in fields(config):
        table = getattr(config, part.name)
        if is_dataclass(table):
            lines += [f"\n[{part.name}]", *(stated(table, item) for item in fields(table))]
    return "\n".join(lines) + "\n"


def test_default_preset_states_every_field_with_its_meaning():
    text = (PACKAGE.parent / "configs" / "default.toml").read_text()
    assert text.endswith(as_toml(Config())), "write configs/default.toml again with as_toml(Config())"
    assert load_config("default") == Config()


def test_paper_preset_is_the_papers():
    config = load_config("paper")
    assert config.fusion.enabled and config.fusion.exposures == ("1/8x", "1/4x", "1x", "8x", "16x")
    assert (config.fusion.sigma, config.loss.linear_weight, config.loss.form) == (0.2, 0.5, "sum")
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
    assert item.metadata["doc"]
    names = [f".{item.name}", f'"{item.name}"']
    if path.startswith("optimizer."):
        names.append("getattr(config.optimizer, name)")
    # In config.py only what follows the declarations counts as reading.
    sources = [
        p.read_text().split("    def scaled")[-1]
        for room in ("training", "model")
        for p in (PACKAGE / room).glob("*.py")
    ]
    assert any(name in source for source in sources for name in names), f"{path} is never read"


@pytest.mark.parametrize(
    "text,words",
    [
        ("[model]\nopacity = 0.2", ["model.opacity", "0.2", "unknown"]),
        ("[schedule]\niterations = 0", ["schedule.iterations = 0", "less than 1"]),
        ("[schedule]\niterations = 1.5", ["schedule.iterations = 1.5", "int"]),
        ("[model]\ninitial_opacity = nan", ["model.initial_opacity = nan", "finite"]),
        ("[model]\nradiance = 'rgb'", ["model.radiance = 'rgb'", "log"]),
        ("[model]\nantialiased = 1", ["model.antialiased = 1", "bool"]),
        ("[fusion]\nexposures = '1'", ["fusion.exposures", "list"]),
        ("[schedule]\nevaluate_at = [0]", ["schedule.evaluate_at = 0"]),
        ("model = 3", ["model = 3", "table"]),
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
        Config(fusion=FusionConfig(enabled=True, exposures=("1",)))
    for name in ("slope_corrected", "revised_opacity"):
        with pytest.raises(InputError, match=rf"densification\.{name} = true is for nothing: needs .* = \"gradient\""):
            load_config("default", {f"densification.{name}": True})
        assert load_config("default", {"densification.strategy": "gradient", f"densification.{name}": True})


def test_iteration_numbers_scale():
    config = load_config("default", {"schedule.iterations": 3000})
    assert config.scaled(15_000) == 1500 and config.scaled(1) == 1
