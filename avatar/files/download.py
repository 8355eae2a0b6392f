"""Downloads over HTTP of bounded size and pace; whatever a server answers, a failure is one sentence."""

from __future__ import annotations

import http.client
import time
import urllib.request
from collections.abc import Iterator

from tqdm import tqdm

from avatar.files.read import shown_size

PATIENCE = 30.0  # seconds without a byte, and before the pace is judged
SLOWEST = 2_000  # bytes a second on average
_CHUNK = 2**16
_LONGEST_REASON = 200


class DownloadFailed(Exception):
    """The message is the reason, without the address."""


def downloaded(url: str, limit: int, title: str) -> Iterator[bytes]:
    """The bytes at `url` as they come, with a progress bar. Raises DownloadFailed, also for more than `limit` bytes."""
    begin, count = time.monotonic(), 0
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE) as response:
            size: int | None = response.length
            if size is not None and size > limit:
                raise DownloadFailed(f"it has {shown_size(size)}, and the published file at most {shown_size(limit)}")
            with tqdm(total=size, unit="B", unit_scale=True, desc=title, leave=False) as bar:
                while chunk := response.read1(_CHUNK):
                    count += len(chunk)
                    seconds = time.monotonic() - begin
                    if count > limit:
                        raise DownloadFailed(f"it has more than {shown_size(limit)}, and the published file less")
                    if seconds > PATIENCE and count < SLOWEST * seconds:
                        raise DownloadFailed(f"it is too slow: {shown_size(count)} in {seconds:.0f} s")
                    bar.update(len(chunk))
                    yield chunk
            if size is not None and count < size:
                raise DownloadFailed(f"it ends after {count} of {size} bytes")
    except (OSError, http.client.HTTPException, ValueError) as error:  # ValueError: an address that is none
        raise DownloadFailed(_reason(error)) from error


def _reason(error: Exception) -> str:
    """What a person can read of it: a server's words may be anything."""
    reason = getattr(error, "reason", None)
    words = str(reason or error) or type(error).__name__
    shown = "".join(letter if letter.isprintable() else " " for letter in words)
    return shown if len(shown) <= _LONGEST_REASON else f"{shown[:_LONGEST_REASON]} ..."
