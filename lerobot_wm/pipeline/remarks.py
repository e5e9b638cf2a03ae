"""Remarks of other libraries that no user can act on."""

import logging


def drop_remarks() -> None:
    """Drop, for good, what LeRobot and PyOpenGL remark where nothing is wrong; all else they log stays."""
    logging.getLogger("lerobot.utils.import_utils").addFilter(_is_not_about_pyav)
    logging.getLogger("lerobot.configs.eval").setLevel(logging.ERROR)  # that it made up a name for the job
    logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # that it is not there


def _is_not_about_pyav(record: logging.LogRecord) -> bool:
    """LeRobot warns once per video that torchcodec is not installed: PyAV decodes them as well."""
    return "'torchcodec' is not available" not in record.getMessage()
