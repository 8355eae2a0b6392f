"""What a check found: how bad it is, what is wrong and where, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from data_prep.formats.frame_files import describe_numbers

Severity = Literal["error", "warning", "note"]
ORDER: tuple[Severity, ...] = ("error", "warning", "note")
FINE, WARNINGS, ERRORS = 0, 1, 2  # exit status


@dataclass(frozen=True)
class Finding:
    severity: Severity  # error: training fails or is spoilt; warning: it is made worse; note: good to know
    check: str  # which check, the same word in every release
    problem: str  # one sentence, with the names of files and frames
    advice: str  # one sentence
    frames: tuple[str, ...] = ()  # all that are concerned, where the sentence has to cut the list


def exit_status(findings: Iterable[Finding]) -> int:
    """0 when all is fine (notes do not count), 1 with warnings, 2 with errors."""
    severities = {finding.severity for finding in findings}
    return ERRORS if "error" in severities else WARNINGS if "warning" in severities else FINE


def by_severity(findings: Sequence[Finding]) -> list[Finding]:
    """Errors first; the order within a severity stays."""
    return sorted(findings, key=lambda finding: ORDER.index(finding.severity))


def count_phrase(findings: Sequence[Finding]) -> str:
    """`2 errors, 1 warning, 3 notes`."""
    counts = [(sum(finding.severity == severity for finding in findings), severity) for severity in ORDER]
    return ", ".join(f"{count} {severity}{'s' * (count != 1)}" for count, severity in counts)


def from_sentence(check: str, sentence: str) -> Finding:
    """An error from a UserError's sentence, `what is wrong; what to do`."""
    problem, _, advice = sentence.rpartition("; ")
    return Finding("error", check, problem or sentence, advice if problem else "mend that, then check again")


def frames_phrase(numbers: Sequence[int], name: Callable[[int], str]) -> str:
    """`frame 00003` or `5 frames (00003-00006, 00009)`, each called by `name`."""
    listed = describe_numbers(list(numbers), name=name)
    return f"frame {listed}" if len(numbers) == 1 else f"{len(numbers)} frames ({listed})"
