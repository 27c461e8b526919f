"""A training that collapsed, as PSNR of the training views tells it beside that of the test views.

Training views that lie far below the others show a part of the scene that is not there; training views far above the
test views, one that was learnt by heart.
"""

from __future__ import annotations

from splatwizard_core.tooling import Record

LARGEST_GAP = 3.0  # dB between the means of training and of test views
MAX_NAMED = 3  # views that a warning names


def collapse_warning(record: Record) -> str | None:
    """One line for the user if training views of a record tell that the training went wrong; None: they do not."""
    training, test = record.training_psnr, record.metrics.get("psnr")
    if training is None:
        return None
    told = [_far_below(record)] if training.far_below else []
    means = training.mean, None if test is None else test.mean
    if means[0] is not None and means[1] is not None and means[0] - means[1] > LARGEST_GAP:
        told.append(
            f"test views have {means[1]:.1f} dB in the mean, training views {means[0]:.1f}: these are learnt by heart, "
            "or the test views are of another kind (path, exposure, poses); look at the worst of them in renders/"
        )
    return f"warning: {record.method} {record.rate}: {'; '.join(told)}" if told else None


def _far_below(record: Record) -> str:
    training, views = record.training_psnr, record.train_views or 0
    assert training is not None
    assert training.median is not None
    names = [f"{name} {value:.1f}" for name, value in list(training.far_below.items())[:MAX_NAMED]]
    more = len(training.far_below) - len(names)
    listed = ", ".join(names) + (f" and {more} more" if more else "")
    return (
        f"{len(training.far_below)} of {views} training views lie far below their median of "
        f"{training.median:.1f} dB ({listed}): part of the scene is missing, or their poses are off; look at them with "
        "`sw render --views train`, and train with another seed or more start points"
    )
