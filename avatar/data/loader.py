"""Frames in a given order, decoded ahead of time in the background, with bounded memory."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from avatar.compute.processors import processor_count
from avatar.data.frame import Frame
from avatar.data.gpu_frame_cache import GpuFrameCache
from avatar.data.subject import FramePixels, Subject

CACHE_BYTES = 2**30  # for decoded frames; what does not fit is decoded again
BYTES_PER_PIXEL = 6  # image 3, alpha, head mask, mouth mask; uint8
FRAMES_AHEAD = 3  # decoded ahead of the training step, for each thread
GPU_WORKERS = 8  # threads that decode for a GPU, which takes frames faster than one can


class FrameLoader:
    """Decoded frames of a subject. Keeps the most recently used ones as uint8, at most CACHE_BYTES of them.

    Use it as a context manager, or call `close`; the frames do not depend on the cache. With a `frame_cache` they are on
    its GPU, and what it holds is decoded once.
    """

    def __init__(self, subject: Subject, size: int | None = None, frame_cache: GpuFrameCache | None = None) -> None:
        self.subject = subject
        self.size = size
        self.cached_bytes = 0
        self._frame_cache = frame_cache
        self._cache: OrderedDict[int, FramePixels] = OrderedDict()  # only touched by the thread that iterates
        workers = 1 if frame_cache is None else min(processor_count(), GPU_WORKERS)
        self._ahead = FRAMES_AHEAD * workers
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="frames")
        self._closed = False

    def __enter__(self) -> FrameLoader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the background thread and forget the cache; a running decode finishes first."""
        self._closed = True
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._cache.clear()
        self.cached_bytes = 0

    def frames(self, indices: Iterable[int]) -> Generator[Frame, None, None]:
        """The frames of `indices`, which may be endless, in that order; a few of them are decoded ahead.

        A frame that cannot be decoded raises its UserError when its turn comes.
        """
        if self._closed:
            raise RuntimeError("the frame loader is closed")
        order = iter(indices)
        queue: deque[tuple[int, Future[FramePixels] | None]] = deque()
        pending: dict[int, Future[FramePixels]] = {}
        try:
            while True:
                while len(queue) < self._ahead:
                    index = next(order, None)
                    if index is None:
                        break
                    if not self._holds(index) and index not in pending:
                        pending[index] = self._pool.submit(self.subject.pixels, index, self.size)
                    queue.append((index, pending.get(index)))
                if not queue:
                    return
                index, future = queue.popleft()
                on_gpu_already = self._frame_cache is not None and index in self._frame_cache
                pixels = None if on_gpu_already else self._take(index, future)
                if not any(waiting == index for waiting, _ in queue):
                    pending.pop(index, None)
                yield self._frame(index, pixels)
        finally:
            for future in pending.values():
                future.cancel()

    def _holds(self, index: int) -> bool:
        return index in self._cache or (self._frame_cache is not None and index in self._frame_cache)

    def _frame(self, index: int, pixels: FramePixels | None) -> Frame:
        if self._frame_cache is not None:
            frame = self._frame_cache.frame(index, pixels, self.size)
            if index in self._frame_cache and index in self._cache:  # in one place only
                self.cached_bytes -= self._cache.pop(index).nbytes
            return frame
        assert pixels is not None
        return self.subject.assemble(index, pixels, self.size)

    def _take(self, index: int, future: Future[FramePixels] | None) -> FramePixels:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        # Evicted between being queued and its turn: decode now.
        pixels = future.result() if future is not None else self.subject.pixels(index, self.size)
        self._remember(index, pixels)
        return pixels

    def _remember(self, index: int, pixels: FramePixels) -> None:
        if pixels.nbytes > CACHE_BYTES:
            return
        self._cache[index] = pixels
        self.cached_bytes += pixels.nbytes
        while self.cached_bytes > CACHE_BYTES:
            _, oldest = self._cache.popitem(last=False)
            self.cached_bytes -= oldest.nbytes
