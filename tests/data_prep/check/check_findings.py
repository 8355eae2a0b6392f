"""What the checks say of a sound folder of the tests anyway."""

from __future__ import annotations

from data_prep.check.findings import Finding
from data_prep.check.folder import Check

ALWAYS = {"short-clip", "small-head", "test-coverage"}  # notes that are true of two dozen frames of 64x64


def new_findings(check: Check) -> dict[str, Finding]:
    return {finding.check: finding for finding in check.findings if finding.check not in ALWAYS}
