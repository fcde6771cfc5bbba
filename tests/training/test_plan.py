"""The plan of a training: what it decides from which figures, what it refuses, and that the training follows it."""

import json
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.runs.config import ScheduleConfig
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene import Camera, codes_of
from sehdr_warp.training.plan import RULES, SCALED_RATES, UNMEASURED, Decision, cpu_step_seconds, make_plan
from sehdr_warp.training.scene_facts import measure_scene
from sehdr_warp.training.strategies import mcmc_cap
from sehdr_warp.training.train import create_trainer, train

from ..refusals import call
from .toy import orbit_camera, toy_scene, with_smaller_photos

GPU, CPU = torch.device("cuda"), torch.device("cpu")


def config_of(**changes):
    changes = {name.replace("__", "."): value for name, value in changes.items()}
    return load_config("default", {"response.name": "srgb", "plan.enabled": True} | changes)


def with_images(scene, change):
    return replace(scene, views=tuple(replace(view, codes=codes_of(change(view))) for view in scene.views))


def fields(plan):
    return {path: value for decision in plan.decisions for path, value in decision.fields.items()}


def test_a_plan_decides_everything_once_with_figures(scene):
    plan = make_plan(scene, config_of())
    assert [decision.name for decision in plan.decisions] == list(RULES)
    for decision in plan.decisions:
        assert any(character.isdigit() for character in decision.reason) or decision.name == "response"
    for path, value in fields(plan).items():
        assert attrgetter(path)(plan.config) == value, path
    assert not plan.config.plan.enabled
    # --resume --plan plans again, on top of the plan.
    assert make_plan(scene, override_config(plan.config, {"plan.enabled": True})).config == plan.config
    assert json.loads(json.dumps(plan.to_dict()))["decisions"]


@pytest.mark.parametrize(
    "name,change,field,few,many",
    [
        ("iterations", {"photos": 200}, "schedule.iterations", 4000, 15_000),
        # Relocation's budget: 120 times the square root of 6144, and of 10^6.
        ("densification", {"pixels": 10**6}, "densification.cap_max", 9406, 120_000),
    ],
)
def test_decisions_follow_their_figures(facts, name, change, field, few, many):
    small = {"photos": 6, "visibility": 3.0, "pixels": 6144}
    # Relocation has a budget of its own.
    config = config_of(**({"densification__strategy": "adc"} if name == "densification" else {}))
    assert RULES[name](replace(facts, **small), config, GPU).fields.get(field) == few
    assert RULES[name](replace(facts, **small | change), config, GPU).fields.get(field) == many


@pytest.mark.parametrize("clipped", [0.0, 1e-4])
def test_clipped_light_is_left_out_where_none_is(facts, clipped):
    weights = RULES["light"](replace(facts, clipped=clipped), config_of(), GPU).fields
    assert weights == ({} if clipped else {"loss.clipped_smoothness": 0.0, "loss.clipped_estimate": 0.0})


@pytest.mark.parametrize("points,choice", [(0, "at most 9406"), (3000, "at most 9406"), (10_000, "without growth")])
def test_a_plan_says_whether_relocation_has_room(facts, points, choice):
    """120 times the square root of 6144 pixels; a scene starts with 20 times as many, if it has no more."""
    decision = RULES["densification"](replace(facts, pixels=6144, points=points), config_of(), GPU)
    assert choice in decision.choice and f"{max(points, 1568)} to start with" in decision.reason


def test_photos_that_clip_below_white_get_a_line(scene):
    def edited(view):
        return np.minimum(2 * view.image, 1) * 243 / 255

    assert measure_scene(with_images(scene, edited)).plateau == 243
    plan = make_plan(with_images(scene, edited), config_of())
    assert any("many pixels have code 243 of 255" in line for line in plan.lines())
    for other in (lambda view: np.minimum(2 * view.image, 1), lambda view: 0.9 * np.sqrt(view.image)):
        assert measure_scene(with_images(scene, other)).plateau == 0


@pytest.mark.parametrize(("clipped", "is_named"), [(0.001, False), (0.065, True)])
def test_photos_that_clip_get_a_line_before_the_training(scene, clipped, is_named):
    plan = make_plan(scene, config_of())
    clips = {"clipped": clipped, "clipped_when_dark": clipped}

    def has_line(**changes):
        lines = replace(plan, facts=replace(plan.facts, **clips | changes)).lines()
        return any("6.5% of the pixels clip" in line and "measure it" in line for line in lines)

    assert has_line() == is_named
    # Light is measured by photos with shorter exposures, and by float pictures.
    assert not has_line(clipped_when_dark=0.001) and not has_line(unclipped=True)
    lines = replace(plan, facts=replace(plan.facts, clipped=0.3, clipped_when_dark=0.065)).lines()
    assert any("the darkest photos clip, too (6.5% of their pixels)" in line for line in lines)


def test_photos_whose_exposure_drifts_unsaid_get_a_line(scene):
    shares = iter(np.linspace(0.1, 0.9, len(scene.views)))
    drifting = with_images(scene, lambda view: np.full_like(view.image, 0.02) + view.image * next(shares))
    for known, line_count in ((False, 1), (True, 0)):
        plan = make_plan(replace(drifting, exposure_times_known=known), config_of())
        for choice, count in ((UNMEASURED, line_count), ("corrected in the photos", 0), ("none", 0)):
            gains = Decision({}, choice, "", "exposure-compensation")
            case = replace(plan, decisions=(*plan.decisions, gains))
            lines = [line for line in case.lines() if "no exposure times" in line and "exposures.json" in line]
            assert len(lines) == count
    plain = make_plan(replace(scene, exposure_times_known=False), config_of())
    assert not any("exposure times" in line for line in plain.lines())


@pytest.mark.parametrize(("part", "on"), [(0.7, True), (0.9, False)])
def test_opacities_are_compensated_where_photos_differ_in_resolution(scene, part, on):
    mixed = with_smaller_photos(scene, part)
    plan = make_plan(mixed, config_of())
    assert plan.config.model.antialiased == on
    assert measure_scene(mixed).focal_ratio == pytest.approx(1 / part, rel=0.05)
    own = make_plan(mixed, config_of(model__antialiased=False, plan__keep=["model.antialiased"]))
    assert not own.config.model.antialiased and not make_plan(scene, config_of()).config.model.antialiased


def test_rates_of_a_short_training_are_raised_once_and_those_given_stay(scene, facts):
    short = {"schedule__iterations": 1000, "plan__keep": ["schedule.iterations", "optimizer.means"]}
    plan = make_plan(scene, config_of(**short))
    rates, usual = plan.config.optimizer, config_of().optimizer
    assert rates.log_scales == pytest.approx(2.11 * usual.log_scales, rel=5e-3)
    assert rates.opacity_logits == pytest.approx(2.11 * usual.opacity_logits, rel=5e-3)
    assert (rates.means, rates.harmonics_dc) == (usual.means, usual.harmonics_dc)
    enough, few, many = (
        RULES["rates"](replace(facts, photos=photos), config_of(schedule__iterations=steps), CPU).fields
        for photos, steps in ((40, 30_000), (40, 1000), (41, 1000))
    )
    assert few and not enough and not many


def test_few_photos_learn_view_dependent_color_slowly(facts):
    def rate(photos: int, **options) -> object:
        decision = RULES["rates"](replace(facts, photos=photos), config_of(schedule__iterations=30_000, **options), CPU)
        return decision.fields.get("optimizer.harmonics_rest")

    assert (rate(16), rate(17)) == (2.5e-4, None)
    assert (rate(4, model__sh_degree=1), rate(5, model__sh_degree=1)) == (2.5e-4, None)
    assert rate(16, optimizer__harmonics_rest=0.01) is None


def test_long_trainings_on_few_photos_leave_gaussians_out(facts):
    def share(photos: int, steps: int = 4000, **options) -> object:
        config = config_of(schedule__iterations=steps, **options)
        return RULES["dropout"](replace(facts, photos=photos), config, CPU).fields.get("model.dropout")

    assert (share(16), share(17)) == (0.2, None)
    assert (share(8, 2000), share(8, 1999)) == (0.2, None)
    assert share(8, model__dropout=0.4) is share(8, densification__strategy="adc") is None


def test_the_plan_names_only_those_rates_that_it_changes(facts):
    def choice(photos: int, steps: int, **options) -> str:
        config = config_of(schedule__iterations=steps, **options)
        return RULES["rates"](replace(facts, photos=photos), config, CPU).choice

    slow, others = "0.00025 for view-dependent color", {f"optimizer__{name}": 0.01 for name in SCALED_RATES[:-1]}
    assert choice(16, 1000) == f"2.11 times, {slow}"
    assert choice(16, 30_000) == choice(16, 1000, **others) == slow
    assert choice(17, 1000, **others) == "2.11 times" and choice(17, 30_000) == "as they are"


def test_a_plan_takes_a_config_in_every_form_that_a_training_takes(scene):
    assert make_plan(scene, device="cpu").config == make_plan(scene, "default", "cpu").config
    assert make_plan(scene, {"model.sh_degree": 1}, "cpu").config.model.sh_degree == 1


def test_a_cpu_gets_the_iterations_that_fit_into_minutes(facts, monkeypatch):
    monkeypatch.setattr("sehdr_warp.training.plan.thread_count", lambda: 2)
    config, rule = config_of(), RULES["iterations"]
    small, large = (replace(facts, photos=200, pixels=200 * side * side) for side in (32, 2000))
    some, few, all_of_them = rule(small, config, CPU), rule(large, config, CPU), rule(small, config, GPU)
    assert all_of_them.fields == {"schedule.iterations": 15_000} and few.fields == {"schedule.iterations": 1000}
    assert "--max-size" in few.reason and "58 min on a CPU" in few.reason
    assert 1000 < some.fields["schedule.iterations"] <= 15_000
    assert cpu_step_seconds(large, config) > 50 * cpu_step_seconds(small, config)
    assert (
        "about 5.0 steps on each of 200 photos leave the scene blurred: --iterations 2000 takes about 117 min"
        in few.reason
    )
    # A photo has ten steps if they take minutes; where they do without that, the time stays what it was.
    sizes = (replace(facts, photos=n, pixels=n * 240 * 135) for n in (264, 100, 600))
    walk, usual, town = (rule(size, config_of(mcmc__cap_density=60.0), CPU) for size in sizes)
    assert walk.fields == {"schedule.iterations": 2700} and usual.fields == {"schedule.iterations": 1000}
    assert walk.reason.startswith("about 4.7 min on a CPU") and "blurred" not in walk.reason + usual.reason
    nearly = rule(replace(facts, photos=264, pixels=264 * 126_000), config_of(mcmc__cap_density=60.0), CPU)
    assert nearly.fields == {"schedule.iterations": 2600} and "blurred" not in nearly.reason
    # More than 4000 steps that are asked for get twice the Gaussians, and take longer.
    assert town.reason.endswith(
        "6.8 steps on each of 600 photos leave the scene blurred: --iterations 6000 takes about 28 min"
    )


def test_a_cpu_short_of_time_gets_half_the_gaussians_unless_steps_are_asked_for(facts, monkeypatch):
    monkeypatch.setattr("sehdr_warp.training.plan.thread_count", lambda: 2)
    large, rule = replace(facts, photos=18, pixels=18 * 200 * 200), RULES["densification"]
    named = config_of(schedule__iterations=4000, plan__keep=["schedule.iterations"])
    assert rule(large, config_of(), CPU).fields == {"mcmc.cap_density": 60.0}
    assert "at most 50911" in rule(large, config_of(), CPU).choice
    for case, config, device in ((facts, config_of(), CPU), (large, config_of(), GPU), (large, named, CPU)):
        assert rule(case, config, device).fields == {}


def test_a_gpu_gets_four_times_the_gaussians_for_many_photos_of_one_place(facts):
    many, rule = replace(facts, photos=21, visibility=9.0), RULES["densification"]
    assert rule(many, config_of(), GPU).fields == {"mcmc.cap_density": 480.0}
    few, survey = replace(many, photos=20), replace(many, visibility=2.0)
    rivals = rule(many, config_of(densification__strategy="adc"), GPU).fields
    assert rivals == {"densification.cap_max": mcmc_cap(config_of(mcmc__cap_density=480.0), many.pixels)}
    others = {"mcmc__cap_density": 60.0}, {"plan__keep": ["mcmc.cap_density"]}
    cases = [(few, config_of(), GPU), (survey, config_of(), GPU), *((many, config_of(**each), GPU) for each in others)]
    for case, config, device in cases:
        assert "mcmc.cap_density" not in rule(case, config, device).fields


def test_brackets_of_one_base_become_a_scaling(scene):
    untrue = replace(scene, views=tuple(replace(view, hdr=None) for view in scene.views))
    plan = make_plan(untrue, load_config("paper", {"response.name": "srgb", "plan.enabled": True}))
    assert not plan.config.fusion.enabled and plan.config.loss.linear_weight == 0
    truth = make_plan(scene, load_config("paper-truth", {"response.name": "srgb", "plan.enabled": True}))
    assert truth.config.loss.linear_weight > 0 and truth.config.loss.hdr_truth


def test_what_the_user_gave_stays(scene):
    plan = make_plan(scene, config_of(schedule__iterations=9000, plan__keep=["schedule.iterations"]))
    assert plan.config.schedule.iterations == 9000
    assert plan.user_fields == {"schedule.iterations": 9000}
    assert "schedule.iterations" not in fields(plan)
    assert "set by you: schedule.iterations = 9000" in plan.table()
    tables = {"iterations": 9000}, ScheduleConfig(iterations=9000)
    for mapping in ({"schedule.iterations": 9000, "seed": 1}, *({"schedule": table} for table in tables)):
        assert make_plan(scene, mapping).config.schedule.iterations == 9000


def outwards(index):
    """A camera on a circle that looks away from its middle, through a long lens."""
    camera = orbit_camera(index)
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    return Camera(32, 32, 400.0, 400.0, 16, 16, turn @ camera.world_to_camera)


@pytest.mark.parametrize(
    "spoil,words",
    [
        (lambda scene: toy_scene(2), ["2 training photos", "20"]),
        (lambda scene: with_images(scene, lambda view: np.full_like(view.image, 0.5)), ["single color", "0.00"]),
        (
            lambda scene: replace(
                scene,
                points=scene.points[:0],
                point_colors=scene.point_colors[:0],
                views=tuple(replace(view, camera=outwards(i)) for i, view in enumerate(scene.views)),
            ),
            ["share no view", "0.0%", "poses"],
        ),
    ],
    ids=["two views", "one colour", "no overlap"],
)
def test_scenes_without_a_plan_get_one_line(scene, spoil, words):
    with pytest.raises(InputError) as caught:
        make_plan(spoil(scene), config_of())
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    "changes,spoil,words",
    [
        ({"densification.cap_max": 20}, None, ["cap_max = 20", "60 points"]),
        ({"loss.hdr_weight": 0.6}, "hdr", ["no training view has", "hdr_weight = 0.6"]),
        ({"loss.hdr_truth": True, "loss.linear_weight": 0.5}, "hdr", ["no training view has", "hdr_truth = true"]),
        (
            {"fusion.enabled": True, "fusion.exposures": ["1x", "1/125s"]},
            "times",
            ["fusion.exposures", "1/125s", "state none"],
        ),
        ({"fusion.enabled": True, "fusion.exposures": ["1x", "30ev"]}, None, ["fusion.exposures", "1.07e+09 times"]),
    ],
)
def test_values_that_the_scene_contradicts_are_refused_with_both(scene, changes, spoil, words, tmp_path):
    if spoil == "hdr":
        scene = replace(scene, views=tuple(replace(view, hdr=None) for view in scene.views))
    if spoil == "times":
        scene = replace(scene, exposure_times_known=False)
    changes |= {"response.name": "srgb"}
    for enabled in (True, False):
        config = load_config("default", changes | {"plan.enabled": enabled, "plan.keep": list(changes)})
        with pytest.raises(InputError) as caught:
            create_trainer(scene, tmp_path / "run", config, device="cpu")
        assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value)
    # What a preset states is not the user's contradiction.
    make_plan(scene, load_config("default", changes), CPU)


def test_a_training_follows_its_plan_and_keeps_it(scene, tmp_path):
    config = config_of(schedule__iterations=12, plan__keep=["schedule.iterations"])
    run = train(scene, tmp_path / "run", config, device="cpu")
    assert [decision["name"] for decision in run.folder.read_decisions()] == [*RULES, "exposure-compensation"]
    assert run.config == make_plan(scene, config).config
    choices = {decision["name"]: decision["choice"] for decision in run.decisions()}
    assert choices["brackets"] == "plain scaling"
    # Asking again for the same plan resumes; without one the old plan goes with the old run.
    assert train(scene, tmp_path / "run", config, device="cpu", resume=True).iterations == 12
    unplanned = load_config("default", {"response.name": "srgb", "schedule.iterations": 2, "plan.enabled": False})
    train(scene, tmp_path / "run", unplanned, device="cpu", overwrite=True)
    assert not RunFolder(tmp_path / "run").plan_file.exists()


def test_plan_only_prints_and_trains_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["train", "embedded", "--plan-only", "--max-size", "48", "--response", "hdr-nerf"]
    assert call(*arguments, "--json", "--schedule.iterations", "500", "--seed", "4") == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["kept"] == {"schedule.iterations": 500} and plan["facts"]["photos"] == 18
    assert call(*arguments) == 0
    table = capsys.readouterr().out
    assert "schedule.iterations = " in table and "kept" not in table
    assert call(*arguments[:2]) == 2 and "--out" in capsys.readouterr().err
    assert call("train", "--resume", *arguments[2:], "--out", "run") == 2 and "--resume" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
