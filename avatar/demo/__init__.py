"""A talking-head subject made by code: for a first try without data, and for tests with known truth."""

from avatar.demo.render import render_frame
from avatar.demo.subject import make_subject

__all__ = ["make_subject", "render_frame"]
