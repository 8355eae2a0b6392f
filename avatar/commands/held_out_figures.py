"""What follows a training where one command does everything: the figures, and their line."""

from __future__ import annotations

from pathlib import Path

from avatar.commands.eval import writing_figures
from avatar.evaluation.evaluate import evaluate, facts_of
from avatar.evaluation.previous_results import read_earlier
from avatar.evaluation.protocol import builtin_protocols
from avatar.evaluation.tracking_source import LABELS, parts
from avatar.files.read import read_json
from avatar.pipeline.open_inputs import open_run


def evaluate_or_read(path: Path, video: Path | None = None) -> Path:
    """RUN/eval/results.json of a run, by all protocols; what was measured already is not measured again. `video` is where
    its tracked folder is now, which may have moved.

    Raises UserError as `evaluate` does.
    """
    run, folder = open_run(path, folder=video, say=discard), path / "eval"
    if builtin_protocols().keys() <= read_earlier(folder, facts_of(run), ()).entries.keys():
        return folder / "results.json"
    with writing_figures(path):
        return evaluate(run, None, write_frames=False, say=discard)


def discard(_: str) -> None:
    """What `avatar eval` prints is a screen of its own."""


def figures_line(results: Path) -> str:
    """Of the head, as the README's table; after a refinement by each tracking, the tracker's first."""
    strict = read_json(results)["protocols"]["strict"]
    own = parts(strict)
    means = [
        f"PSNR {part.figures['means']['psnr_head']:.2f}, SSIM {part.figures['means']['ssim_head']:.4f}"
        + (f" ({LABELS[drive]})" if len(own) > 1 else "")
        for drive, part in own.items()
    ]
    return f"{'; '.join(means)} over {len(strict['frames'])} of them, head only"
