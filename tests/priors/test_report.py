"""The page about the prior is made of the figures in the repository."""

from pathlib import Path

from priors import report

ROOT = Path(report.__file__).resolve().parents[1]


def test_the_page_of_the_guide_is_that_of_the_figures(tmp_path):
    (tmp_path / "images").mkdir()
    report.main(ROOT / "priors" / "figures.json", ROOT / "priors" / "brackets.json", tmp_path)
    page, stored = (folder / "light-prior.md" for folder in (tmp_path, ROOT / "docs"))
    assert page.read_text() == stored.read_text(), "run python -m priors.report, as in priors/README.md"
    assert (tmp_path / "images" / "light-prior.png").stat().st_size > 10_000
