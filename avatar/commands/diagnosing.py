"""avatar doctor: what this installation can do."""

from __future__ import annotations

from argparse import Namespace

from avatar.doctor import diagnose


def run_doctor(_: Namespace) -> int:
    return diagnose()
