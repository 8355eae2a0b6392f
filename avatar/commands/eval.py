"""avatar eval: a trained avatar's figures on the held-out frames."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avatar.errors import UserError
from avatar.evaluation.evaluate import evaluate
from avatar.evaluation.protocol import choose_protocols
from avatar.files.lock import locked
from avatar.pipeline import OK
from avatar.pipeline.choose_device import choose_device
from avatar.pipeline.open_inputs import open_run


def run_eval(arguments: Namespace) -> int:
    run = open_run(arguments.run, arguments.head, arguments.folder)
    run.avatar.to(choose_device(arguments.device or "auto", print))
    with writing_figures(run.path):
        results = evaluate(run, arguments.protocol, write_frames=arguments.frames or arguments.verify)
        if arguments.verify:
            from avatar.evaluation.verify import verify  # imports scikit-image, which nothing else here needs

            verify(results, [protocol.name for protocol in choose_protocols(arguments.protocol)])
    return OK


@contextmanager
def writing_figures(run: Path) -> Iterator[None]:
    """RUN/eval for this process alone. Raises UserError where another evaluates the run, or the disk refuses."""
    folder, otherwise = run / "eval", "free some space, or copy the run to a place that can be written"
    with locked(folder, otherwise):
        try:
            yield
        except OSError as error:
            raise UserError(f"{folder} cannot be written ({error.strerror or error}); {otherwise}") from error
