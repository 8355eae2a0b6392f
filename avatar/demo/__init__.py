"""A talking-head subject made by code: for a first try without data, and for tests with known truth."""

from avatar.demo.raw_video import make_video
from avatar.demo.render import render_frame
from avatar.demo.subject import make_head_model, make_subject

__all__ = ["make_head_model", "make_subject", "make_video", "render_frame"]
