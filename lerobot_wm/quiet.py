"""Keeping other libraries' chatter off the screen; their errors are shown."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import av.logging
import datasets


@contextmanager
def quiet() -> Iterator[None]:
    """Keep what LeRobot, `datasets` and the codec print per episode off the screen, errors excepted.

    The codec stays quiet: its level cannot be asked for, and where LeRobot has encoded it tells the terminal all.
    """
    logger = logging.getLogger("lerobot")
    level = logger.level
    bars = datasets.utils.logging.is_progress_bar_enabled()
    try:
        with warnings.catch_warnings():
            silence()
            yield
    finally:
        logger.setLevel(level)
        if bars:
            datasets.enable_progress_bars()


def silence() -> None:
    """The same for a process of ours, for good."""
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    av.logging.set_libav_level(av.logging.ERROR)
    datasets.disable_progress_bars()
    # Experts command more than +-1 by design; their actions are clipped before they are recorded.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high")


def drop_remarks() -> None:
    """Drop, for good, what LeRobot and PyOpenGL remark where nothing is wrong; all else they log stays."""
    logging.getLogger("lerobot.utils.import_utils").addFilter(_is_not_about_pyav)
    logging.getLogger("lerobot.configs.eval").setLevel(logging.ERROR)  # that it made up a name for the job
    logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # that it is not there


def _is_not_about_pyav(record: logging.LogRecord) -> bool:
    """LeRobot warns once per video that torchcodec is not installed: PyAV decodes them as well."""
    return "'torchcodec' is not available" not in record.getMessage()
