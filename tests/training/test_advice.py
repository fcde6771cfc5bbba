from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.config_flags import parse_field
from sehdr_warp.scene.pose_conventions import MISFIT
from sehdr_warp.training.advice import FinishedTraining, advice_on, option_words, options_of_run
from sehdr_warp.training.train import train

from .toy import toy_scene


def advice(*facts, **more):
    return FinishedTraining(*facts, **more).advice()


def summary(decibels, regions=0, stops=2.0):
    """A training of 90 iterations with evaluations spread evenly over it."""
    step = 90 // len(decibels)
    metrics = [{"iteration": (i + 1) * step, "split": "test", "psnr_ldr": value} for i, value in enumerate(decibels)]
    worst = [{"photo": f"p{i}", "stops": stops} for i in range(min(regions, 20))]
    return {"iteration": 90, "metrics": metrics, "unexplained": {"regions": regions, "photos": 3, "worst": worst}}


def test_a_training_that_still_gains_is_advised_to_continue():
    [line] = advice(Path("runs/my run"), summary([20, 22, 23, 24]), 50)
    assert line.endswith("sehdr-warp train --resume --out 'runs/my run' --iterations 180") and "2.0 dB" in line


def test_a_few_steps_say_nothing_of_the_photos():
    [line] = advice(Path("r"), summary([9, 9, 9], regions=400), 30, steps=90)
    assert line == "90 steps are too few to judge 30 photos by: sehdr-warp train --resume --out r --iterations 2250"
    for photos, steps in ((29, 90), (30, None)):  # More for each photo, or as many as were planned.
        assert "does not fit" in advice(Path("r"), summary([9, 9, 9]), photos, steps=steps)[0]


def test_gains_before_a_resume_do_not_count():
    """The last evaluation of a training has its moving average, so the one at a resume is the one to compare with."""
    figures = summary([20, 22, 24, 25.0, 25.1])
    assert "1.1 dB since iteration 54" in advice(Path("r"), figures, 50)[0]
    assert advice(Path("r"), figures, 50, resumed_at=72) == []
    # An interrupted training was not evaluated there; the steps before it are of the same schedule.
    assert advice(Path("r"), figures, 50, resumed_at=75) == advice(Path("r"), figures, 50)


def test_light_that_is_an_estimate_comes_first():
    first, second = advice(Path("r"), summary([20, 22, 23, 24]) | {"estimated_light": 0.754}, 50)
    assert first.startswith("75% of the light is an estimate") and first.endswith("how many stops: sehdr-warp lights r")
    assert "more steps help" in second
    assert len(advice(Path("r"), summary([20, 22, 23, 24]) | {"estimated_light": 0.4}, 50)) == 1


def test_many_photos_without_a_camera_are_the_first_advice():
    lines = advice(Path("r"), summary([20, 22, 23, 24]), 8, "photos", unplaced=20)
    assert len(lines) == 2 and lines[0].startswith("20 photos have no camera and are not in the scene;")
    assert len(advice(Path("r"), summary([20, 22, 23, 24]), 12, unplaced=5)) == 1
    assert len(advice(Path("r"), summary([0]) | {"metrics": []}, 4, unplaced=9)) == 1
    assert len(advice(Path("r"), summary([22, 22, 22]), 9, unplaced=9)) == 1


def test_photos_that_hold_no_more_are_named():
    [line] = advice(Path("r"), summary([20, 26, 25, 24]), 12)
    assert "2.0 dB better at iteration 44" in line and "12 photos" in line


def test_photos_of_another_exposure_are_named_with_the_command():
    figures = summary([28, 28, 28], regions=100) | {"brightness_offsets": {"a": 0.1, "b": -0.9, "c": 0.5, "d": 0.0}}
    [line] = advice(Path("r"), figures, 10, "my photos")
    assert line.startswith("2 photos are brighter or darker") and "b -0.9, c +0.5" in line
    assert line.endswith("or move these photos out of the folder: sehdr-warp train 'my photos' --out r --overwrite")
    figures["brightness_offsets"]["d"] = 1.0  # Most of them
    assert "as in photos of several days or cameras: train on those of one day" in advice(Path("r"), figures, 10)[0]


def test_dark_photos_that_measure_lights_are_kept():
    figures = summary([28, 28, 28], regions=100) | {"brightness_offsets": {"a": 0.6, "b": -0.9, "c": 0.1, "d": 0.0}}
    [line] = advice(Path("r"), figures, 10, "room", dark={"a", "b"})
    assert line.startswith("2 photos are brighter or darker") and "keep them, because they measure lights" in line
    assert "move these" not in line and line.endswith("sehdr-warp train room --out r --overwrite")
    [line] = advice(Path("r"), figures, 10, "room", dark={"a"})
    assert line.startswith("1 photo is brighter or darker") and "(stops: b -0.9)" in line and "move these" in line


@pytest.mark.parametrize(("factor", "kept"), [(0.5, False), (0.25, True)])
def test_photos_of_a_quarter_of_the_usual_exposure_are_dark(factor, kept):
    scene = toy_scene(6, 8)
    dark = replace(scene.train_views[0], exposure_time=factor * scene.train_views[0].exposure_time)
    scene = replace(scene, views=tuple(dark if view.name == dark.name else view for view in scene.views))
    figures = summary([28, 28, 28]) | {"brightness_offsets": {dark.name: 0.9, "other": 0.0}}
    run = SimpleNamespace(path=Path("r"), summary=lambda: figures, metrics=lambda: figures["metrics"])
    config = SimpleNamespace(plan=SimpleNamespace(keep=[]))
    facts = {"run": run, "iteration": 90, "total": 90, "first_iteration": 0, "config": config}
    [line] = advice_on(SimpleNamespace(scene=scene, **facts), {"path": "set"}, {})
    assert ("keep them, because they measure lights" in line) == kept


def test_commands_keep_the_options_of_the_training():
    options = ["--max-size", "240", "--preset", "fast"]
    [line] = advice(Path("r"), summary([20, 26, 25, 24]), 12, "park", options)
    assert line.endswith("sehdr-warp train park --out r --max-size 240 --preset fast --overwrite --iterations 44")
    [line] = advice(Path("r"), summary([20, 26, 25, 24]), 12, "park", options, steps=90)
    assert line.count("--iterations") == 1 and line.endswith("--iterations 44")
    [line] = advice(Path("r"), summary([22, 22, 22]), 12, "park", options, steps=90)
    assert line.endswith("--preset fast --overwrite --iterations 90")
    assert option_words({"max_size": 240, "holdout": None, "schedule.iterations": 9, "preset": "fast"}) == options


def test_a_resumed_training_is_repeated_with_the_fields_of_its_run(tmp_path):
    fields = {"seed": 7, "schedule.iterations": 4, "loss.ssim_weight": 0.3, "plan.keep": ("loss.ssim_weight", "seed")}
    train(toy_scene(), tmp_path / "run", load_config("3dgs", fields), device="cpu")
    run = train(toy_scene(), tmp_path / "run", device="cpu", resume=True)
    options = options_of_run(run)
    assert "--plan.keep" not in option_words(options) and "--schedule.iterations" not in option_words(options)
    again = load_config("default", {name: parse_field(name, text) for name, text in options.items()})
    assert (again.seed, again.loss.ssim_weight) == (7, 0.3)
    assert again.densification.strategy == run.config.densification.strategy == "adc", "the preset's fields are stated"
    config = load_config("default", {"schedule.iterations": 2, "plan.keep": ("schedule.iterations",)})
    planned = train(toy_scene(), tmp_path / "planned", config, device="cpu")
    assert planned.decisions() and "plan.enabled" not in options_of_run(planned), "the command plans as the run did"


def test_a_training_that_is_too_short_blames_nothing_that_moved():
    for decibels in ([20, 22, 24], [28, 28, 28.3]):
        [line] = advice(Path("r"), summary(decibels, regions=100), 10)
        assert "more steps help" in line
    assert advice(Path("r"), summary([12, 13], regions=100) | {"brightness_offsets": {"p0": 0.9}}, 10) == []


def test_a_long_training_gets_advice_after_one_or_two_evaluations():
    for decibels in ([28], [20, 28]):  # 90 steps on one photo, the first evaluation at half of them
        figures = summary(decibels, regions=100)
        if len(decibels) == 2:
            assert "gained 8.0 dB since iteration 45" in advice(Path("r"), figures, 1)[0]
            figures["metrics"][0]["iteration"] = 5  # Says nothing of the end
        [line] = advice(Path("r"), figures, 1)
        assert "masks/PHOTO.png" in line
        [line] = advice(Path("r"), figures | {"brightness_offsets": {"p0": 0.9}}, 1)
        assert line.startswith("1 photo is brighter or darker")
    assert "does not fit" in advice(Path("r"), summary([13]), 1)[0]


def test_few_photos_and_movement():
    assert "photos are few" in advice(Path("r"), summary([20, 21, 21.05]), 8)[0]
    [line] = advice(Path("r"), summary([28, 28, 28], regions=100), 10)
    assert "masks/PHOTO.png" in line and "p0, p1, p2 ..." in line
    assert advice(Path("r"), summary([28, 28, 28], regions=100, stops=-1.1), 10) == []  # Blur
    uncertain = {f"p{i}" for i in range(5, 16)}
    [line] = advice(Path("r"), summary([28, 28, 28], regions=100), 20, uncertain=uncertain)
    assert "cameras are uncertain (p5, p6, p7 ...): add photos" in line and "masks" not in line
    [line] = advice(Path("r"), summary([28, 28, 28], regions=100), 20, uncertain={"p5", "p6"})
    assert "masks/PHOTO.png" in line
    assert advice(Path("r"), summary([28, 28, 28]), 100) == []
    assert advice(Path("r"), {"iteration": 9, "metrics": []}, 6) == []
    # A set that is too small to hold photos out does not tell whether things moved.
    [line] = advice(Path("r"), summary([28], regions=100) | {"metrics": []}, 3)
    assert line.startswith("3 photos are few")


def test_single_photos_that_show_another_scene_have_wrong_cameras():
    figures, sizes = summary([28, 28, 28]), {f"p{i}": 1000 for i in range(40)}

    def lines(photos, stops=7.0, pixels=80, offset=0.0, figures=figures, **options):
        worst = [{"photo": f"p{i}", "stops": sign * stops, "pixels": pixels} for i in range(photos) for sign in (1, -1)]
        found = {"unexplained": {"regions": len(worst), "worst": worst}, "brightness_offsets": {"p0": offset}}
        return advice(Path("r"), figures | found, 40, **{"sizes": sizes} | options)

    [line] = lines(2)
    assert (
        line.startswith("the cameras of p0, p1 seem wrong: these photos") and "; move them out of the folder: " in line
    )
    [line] = lines(1)
    assert (
        line.startswith("the camera of p0 seems wrong: this photo alone shows")
        and "; move it out of the folder: " in line
    )
    assert lines(2, pixels=50) == lines(2, stops=2.0) == lines(5) == lines(2, sizes={}) == []
    [line] = lines(1, figures=summary([26, 27, 28]))
    assert "more steps help" in line
    [line] = lines(1, offset=5.0)
    assert line.startswith("1 photo is brighter or darker")


def test_a_scene_that_fits_nowhere_blames_cameras_and_overlap_and_nothing_that_moved():
    figures = summary([11, 14.9, 15.2], regions=100)
    [line] = advice(Path("r"), figures, 54, "set", posed="set/images")
    assert (
        line.startswith("held-out photos reach 15.2 dB at best")
        and "show different light, or their cameras are wrong" in line
    )
    assert line.endswith("from the photos alone: sehdr-warp train set/images --out r --overwrite")
    [line] = advice(Path("r"), figures, 54, "photos")
    assert line.endswith("would help most: sehdr-warp train photos --out r --overwrite") and "anew" not in line
    assert "more steps help" in advice(Path("r"), summary([11, 13, 15]), 54)[0]
    [line] = advice(Path("r"), summary([22, 22, 22], regions=900), 54, posed="set/images", misfit=True)
    assert line.startswith("the cameras that the set states do not fit its photos") and "set/images" in line
    [line] = advice(Path("r"), figures, 54, "set", posed="set")  # Beside the file of their poses
    assert line.endswith("in a folder PHOTOS of their own: sehdr-warp train PHOTOS --out r --overwrite")


def test_cameras_are_found_anew_from_all_photos():
    """The command must not name one folder of a rig alone."""
    scene = toy_scene(4, 8)
    run = SimpleNamespace(path=Path("r"), summary=lambda: summary([22]), metrics=list)
    config = SimpleNamespace(plan=SimpleNamespace(keep=[]))
    facts = {"run": run, "iteration": 3, "total": 3, "first_iteration": 0, "config": config}
    for folders, end in ((["a", "a"], "alone: sehdr-warp train set/a"), (["a", "b"], "own: sehdr-warp train PHOTOS")):
        places = [Path("set", folder, view.name) for folder, view in zip(2 * folders, scene.views, strict=True)]
        views = tuple(replace(view, source=place) for view, place in zip(scene.views, places, strict=True))
        rig = replace(scene, views=views, format="colmap", notes=(f"poses: images.txt {MISFIT}: far",))
        [line] = advice_on(SimpleNamespace(scene=rig, **facts), {"path": "set"}, {})
        assert line.startswith("the cameras that the set states do not fit its photos")
        assert line.endswith(f"{end} --out r --overwrite")
