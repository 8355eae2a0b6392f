"""`avatar check SUBJECT`: read everything, gather all findings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avatar.data.source import Source
from avatar.errors import UserError
from avatar.head.assets import HeadAssets
from data_prep.check.check_cameras import check_cameras
from data_prep.check.check_files import check_files, lost_frames
from data_prep.check.check_fit import check_fit
from data_prep.check.check_head import check_head
from data_prep.check.check_images import check_images
from data_prep.check.check_motion import check_motion
from data_prep.check.check_tracking import check_tracking
from data_prep.check.clip import Clip, read_clip
from data_prep.check.coverage import Coverage, check_coverage, measure_coverage
from data_prep.check.findings import Finding, by_severity, count_phrase, exit_status, from_sentence
from data_prep.prepare.pairing import describe_reasons
from data_prep.prepare.wrong_inputs import check_folder, check_numbers
from data_prep.progress import Progress, silent

VERDICTS = ("ready to train", "can be trained on, with flaws", "training would fail or be spoilt")  # by exit status


@dataclass(frozen=True)
class Check:
    """The outcome of a check."""

    folder: Path
    findings: tuple[Finding, ...]  # errors first
    clip: Clip | None  # None where there is no folder
    coverage: Coverage | None

    @property
    def status(self) -> int:
        return exit_status(self.findings)

    def summary(self) -> str:
        return f"{count_phrase(self.findings)}: {VERDICTS[self.status]}"

    def to_dict(self) -> dict[str, Any]:
        return {
            "folder": str(self.folder),
            "exit_status": self.status,
            "summary": self.summary(),
            "facts": {} if self.clip is None else facts(self.clip, self.coverage),
            "findings": [asdict(finding) for finding in self.findings],
        }


def check_tracked_folder(
    folder: Path,
    load_head: Callable[[], HeadAssets],
    *,
    progress: Progress = silent,
    **options: Any,
) -> Check:
    """Check a tracked folder as `prepare` would read it; `options` are those of a `Source`.

    A folder that is not there or has no head model is a finding.
    """
    findings: list[Finding] = []
    assets = None
    try:
        check_folder(folder)
        source = Source(folder.resolve(), folder, **options)  # its head model is what `load_head` gives
        check_numbers(source)
    except UserError as error:
        return Check(folder, (from_sentence("layout", str(error)),), None, None)
    try:
        assets = load_head()
    except UserError as error:
        findings.append(from_sentence("head-model", str(error)))
    try:
        clip = read_clip(source, assets, progress)
    except UserError as error:
        return Check(folder, (from_sentence("layout", str(error)),), None, None)
    findings += [] if assets is None else check_head(assets)
    findings += check_files(clip) + check_tracking(clip) + check_motion(clip) + check_fit(clip)
    findings += check_images(clip)
    if assets is not None and (size := clip.size()) is not None:
        findings += check_cameras(clip, assets, size)
    findings += [Finding("note", "format", note, "nothing, if that is meant") for note in clip.source.notes]
    if not any(finding.severity == "error" for finding in findings):
        findings += lost_frames(clip)
    usable = [image for image, _ in clip.tracked() if image not in clip.left_out]
    coverage = None
    if clip.offset is not None:
        measured = measure_coverage(clip, usable)
        if isinstance(measured, Finding):
            findings.append(measured)
        else:
            coverage = measured
            findings += check_coverage(clip, measured)
    return Check(folder, tuple(by_severity(findings)), clip, coverage)


def facts(clip: Clip, coverage: Coverage | None) -> dict[str, Any]:
    """Figures about the clip, none of which is a judgement."""
    found: dict[str, Any] = {"format": clip.source.format}
    for kind, paths in clip.files.of_kind().items():
        if paths or not clip.source.is_paired:  # the other formats have no place for some kinds
            found[f"files in {clip.files.title(kind)}"] = len(paths)
    if (size := clip.size()) is not None:
        found["image size"] = f"{size[0]}x{size[1]}"
    found["frames a second"] = f"{clip.fps:g}{'' if clip.given.fps or clip.source.fps else ' (assumed)'}"
    found |= {"frame offset": clip.offset, "offset found": clip.offset_evidence}
    first = next(iter(clip.tracking.frames.values()), None)
    if first is not None:
        found["intrinsics fx fy cx cy"] = [round(float(value), 3) for value in first.intrinsics]
        fov = np.degrees(2 * np.arctan(0.5 * first.size[0] / first.intrinsics[0]))
        found["field of view"] = f"{fov:.1f} degrees"
    if clip.fits:
        found["head outside the picture, median"] = f"{np.median([fit.outside for fit in clip.fits.values()]):.1%}"
        for name, title in (
            ("overlap", "overlap of mesh and head mask (IoU), median"),
            ("overhang", "mesh sticks out of the head mask, median, pixels"),
            ("lips", "overlap of lips and mouth mask (IoU), median"),
            ("mouth", "lips to mouth mask, median, pixels"),
        ):
            values = np.array([getattr(fit, name) for fit in clip.fits.values()])
            if (finite := values[np.isfinite(values)]).size:
                found[title] = round(float(np.median(finite)), 3)
    found["frames left out"] = describe_reasons(clip.left_out, clip.name) if clip.left_out else 0
    if coverage is not None:
        found["usable frames"] = len(coverage.images)
        found["training frames"], found["held-out frames"] = len(coverage.split.train), len(coverage.split.test)
        for name in ("yaw", "pitch", "roll"):
            low, high = np.percentile(getattr(coverage.angles, name), [0, 100])
            found[f"{name}"] = f"{low:.1f} to {high:.1f} degrees"
    return found


def as_text(check: Check) -> str:
    """For the terminal: figures, findings, verdict."""
    lines = [f"{check.folder}"]
    if check.clip is not None:
        lines += [f"  {name}: {value}" for name, value in facts(check.clip, check.coverage).items()]
    for finding in check.findings:
        lines += ["", f"{finding.severity.upper()} [{finding.check}] {finding.problem}", f"  -> {finding.advice}"]
    return "\n".join([*lines, "", check.summary()])
