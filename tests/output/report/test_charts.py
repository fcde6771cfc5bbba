"""Charts of trainings."""

from sehdr_warp.output.report.charts import training_chart

from ..helpers import METRICS


def test_the_chart_has_a_line_for_every_run_and_a_name_for_every_row():
    figure = training_chart({"sky": [METRICS]})
    curves = [[line.get_xydata().tolist() for line in axes.get_lines()] for axes in figure.axes]
    assert curves == [[[[1.5, 20.0], [3.0, 26.0]]], [[[1.5, 18.0], [3.0, 25.5]]]]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["Photos: 26.0 dB", "HDR, mu-law (gt-max): 25.5 dB"] and not figure.legends
    only = [{"seconds": 1.0, "psnr_ldr": 20.0}, {"iteration": 3}]
    figure = training_chart({"a and 1 more": [METRICS, METRICS], "c": [only]})
    assert [len(axes.get_lines()) for axes in figure.axes] == [3, 2]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a and 1 more", "c"]
