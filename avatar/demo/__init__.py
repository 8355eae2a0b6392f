"""A talking-head subject made by code: for a first try without data, and for tests with known truth."""

from avatar.demo.raw_video import make_video
from avatar.demo.render import render_frame
from avatar.demo.subject import make_head_model, make_subject
from avatar.demo.vhap_folder import make_camera_folder

__all__ = ["make_camera_folder", "make_head_model", "make_subject", "make_video", "render_frame"]
