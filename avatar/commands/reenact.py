"""avatar reenact: a person's motion on another person's avatar."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import fields
from pathlib import Path

from avatar.commands.outputs import check_file, check_outputs
from avatar.errors import UserError
from avatar.files.names import safe_name
from avatar.files.numbered import existing
from avatar.files.video import ALPHA_SUFFIXES, VIDEO_SUFFIXES
from avatar.pipeline import OK
from avatar.pipeline.backdrop import parse_backdrop
from avatar.pipeline.cached_tracking import cached_tracking, is_video
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.open_inputs import DRIVE_SUFFIXES, open_drive_file, open_driver
from avatar.pipeline.reenact import PICTURES, Choices, check_choices, first_file, reenact, sidecars
from avatar.runs.run import RUN_FILE, open_trained, read_run_info
from avatar.runs.trained_avatar import TrainedAvatar
from data_prep.formats.avatar_track import read_info

READING_OPTIONS = ("driver_tracking", "frame_offset", "data_format", "cameras", "fps", "max_left_out")


def run_reenact(arguments: Namespace) -> int:
    choices = Choices(**{field.name: getattr(arguments, field.name) for field in fields(Choices)})
    check_choices(choices)
    driver: Path = arguments.driver
    is_drive_file = driver.suffix.lower() in DRIVE_SUFFIXES
    if is_drive_file:
        refuse_reading_options(arguments)
    trained = open_trained(arguments.run, arguments.head)
    trained.avatar.to(choose_device(arguments.device or "auto", print))
    backdrop = None if arguments.background is None else parse_backdrop(arguments.background)
    has_alpha = backdrop is not None and backdrop.behind is None
    out = arguments.out or default_video(arguments.run, driver, choices, ".webm" if has_alpha else ".mp4")
    check_file(
        out,
        [*(ALPHA_SUFFIXES if has_alpha else VIDEO_SUFFIXES), PICTURES],
        "a transparent video" if has_alpha else "a video",
    )
    behind = None if arguments.background is None else Path(arguments.background)
    inputs = [driver, behind, arguments.run, arguments.head, arguments.driver_tracking, trained.source]
    check_outputs([first_file(out), *(existing(out) if first_file(out) != out else ()), *sidecars(out)], inputs)
    if is_drive_file:
        reenact(trained, open_drive_file(driver, trained), out, choices, backdrop=backdrop)
    else:
        sound = None
        if is_video(driver):
            video, driver = driver, cached_tracking(driver, head_of(arguments, trained), trained.assets)
            info = read_info(driver)
            sound = (video, info.source["begins"], info.fps) if video.is_file() else None
        reenact(trained, open_driver(driver, trained, arguments), out, choices, backdrop=backdrop, sound=sound)
    return OK


def refuse_reading_options(arguments: Namespace) -> None:
    """Raises UserError for options that say how a tracked folder is read."""
    if given := [name for name in READING_OPTIONS if getattr(arguments, name) is not None]:
        raise UserError(
            f"--{given[0].replace('_', '-')} is for tracked folders, and {arguments.driver} is a drive file: leave it out"
        )


def head_of(arguments: Namespace, trained: TrainedAvatar) -> Path:
    """Where the avatar's head model lies, with the files beside it that tracking uses: names, landmarks."""
    if arguments.head is not None:
        return arguments.head
    recorded = read_run_info(arguments.run).source.head if (arguments.run / RUN_FILE).is_file() else None
    return recorded if recorded is not None and recorded.exists() else trained.source


def default_video(avatar: Path, driver: Path, choices: Choices, suffix: str = ".mp4") -> Path:
    """RUN/reenact/DRIVER-TRANSFER.mp4, or so; reenact/... in the current folder for an avatar that is a file alone."""
    folder = avatar if (avatar / RUN_FILE).is_file() else Path()
    return folder / "reenact" / f"{safe_name(driver.resolve().stem)}-{choices.transfer}{suffix}"
