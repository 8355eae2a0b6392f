"""avatar sweep-job: one job of a sweep, in a process of its own. The engines of `avatar sweep` call it, and nobody else."""

from __future__ import annotations

from argparse import Namespace

from avatar.commands.main import main
from avatar.pipeline import OK
from avatar.sweep.job import run_job


def run_sweep_job(arguments: Namespace) -> int:
    run_job(arguments.folder, lambda words: main(words))
    return OK
