"""The plan of a training: what its scene does not need, decided before it begins, each with a reason in figures."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from ..scene import Scene
from .config import Config
from .config_files import config_to_dict, override_config
from .plan_checks import check_fields, check_scene
from .plan_rules import RULES, Decision
from .plan_scene import SceneFacts, measure_scene

PLAN = "plan.json"
"""The plan's file in the folder of a run."""


@dataclass(frozen=True)
class Plan:
    """What was decided about a scene.

    config: the config with the decisions in it, ready to be trained. facts: what they rest on. decisions: in the order
    of RULES. kept: fields that a decision would have changed and the user had given.
    """

    config: Config
    facts: SceneFacts
    decisions: tuple[Decision, ...]
    kept: dict[str, object]

    def to_dict(self) -> dict:
        """Plain values, for plan.json and --json."""
        return {
            "decisions": [asdict(decision) for decision in self.decisions],
            "kept": self.kept,
            "facts": asdict(self.facts),
        }

    def table(self) -> str:
        """The decisions as lines: what, which values, and why."""
        return format_plan(self.to_dict())


def make_plan(scene: Scene, config: Config) -> Plan:
    """Reads a scene and decides what its training can leave out, on top of a config.

    The fields in config.plan.keep stay as they are. The plan's own config has
    plan.enabled off.

    Raises InputError for a scene that no plan makes sense for, and for kept values that the scene contradicts.
    """
    facts = measure_scene(scene, config.seed)
    check_scene(scene, facts)
    check_fields(scene, facts, config, config.plan.keep)
    planned, decisions, kept = config, [], {}
    for name, rule in RULES.items():
        decision = rule(facts, planned)
        changes = {path: value for path, value in decision.fields.items() if path not in config.plan.keep}
        current = _flat(config_to_dict(planned))
        kept |= {path: current[path] for path in decision.fields if path not in changes}
        decisions.append(Decision(name, changes, decision.choice, decision.reason))
        planned = override_config(planned, changes, f"{scene.name}: plan of {name}")
    planned = override_config(planned, {"plan.enabled": False}, scene.name)
    return Plan(planned, facts, tuple(decisions), kept)


def apply_plan(scene: Scene, config: Config) -> tuple[Config, Plan | None]:
    """The config to train a scene with, and its plan where config.plan asks for one; without, the fields in plan.keep
    are checked against the scene all the same. Raises InputError as make_plan does."""
    if config.plan.enabled:
        plan = make_plan(scene, config)
        return plan.config, plan
    if config.plan.keep:
        check_fields(scene, measure_scene(scene, config.seed), config, config.plan.keep)
    return config, None


def read_plan(folder: Path) -> dict | None:
    """The plan that a run was trained by, as Plan.to_dict gave it; None without one, or where its file is damaged."""
    try:
        values = json.loads((folder / PLAN).read_text(encoding="utf-8"))
        format_plan(values)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return values


def format_plan(values: dict) -> str:
    """A table of Plan.to_dict()'s decisions."""
    rows = []
    for decision in values["decisions"]:
        fields = ", ".join(f"{path} = {json.dumps(value)}" for path, value in decision["fields"].items())
        rows.append((decision["name"], decision["choice"], fields, decision["reason"]))
    name, choice = (max(len(row[column]) for row in rows) for column in (0, 1)) if rows else (0, 0)
    lines = []
    for row in rows:
        lines.append(f"{row[0]:{name}}  {row[1]:{choice}}  {row[3]}")
        if row[2]:
            lines.append(f"{'':{name}}  {'':{choice}}  -> {row[2]}")
    for path, value in values["kept"].items():
        lines.append(f"kept as given: {path} = {json.dumps(value)}")
    return "\n".join(lines)


def _flat(values: dict, prefix: str = "") -> dict:
    found = {}
    for key, value in values.items():
        found |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found
