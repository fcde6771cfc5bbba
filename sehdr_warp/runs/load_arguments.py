"""Arguments of load_scene() that a run saves, so that its photos can be loaded again."""

from typing import TypedDict

LOAD_OPTIONS = ("exposure_index", "max_size", "holdout")
"""Names of LoadArguments that are options of the command line."""


class LoadArguments(TypedDict, total=False):
    """Arguments of load_scene() that a run saves in run.json, so that its photos can be loaded again.

    Attributes:
        path: Where the photos are: a folder, a video, or "embedded"; None or left out if that is not known.
        exposure_index: As in load_scene().
        max_size: As in load_scene().
        holdout: As in load_scene().
        views: Names of the views to read, if only some are.
    """

    path: str | None
    exposure_index: int | None
    max_size: int | None
    holdout: int | None
    views: list[str]
