"""What libraries do to logging leaves the tests' captured streams open."""

from __future__ import annotations

from absl import logging as absl_logging


def test_closing_the_handlers_of_logging_leaves_the_captured_streams_open() -> None:
    """`logging.config` closes them all, and pytest would end in `I/O operation on closed file`."""
    handler = absl_logging.get_absl_handler()
    handler.close()
    assert not handler.python_handler.stream.closed
