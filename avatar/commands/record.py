"""avatar record: a film of one person by the webcam, with prompts on the screen."""

from __future__ import annotations

import sys
from argparse import Namespace
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from avatar.commands.outputs import check_file, check_outputs
from avatar.compute.interruption import interruption
from avatar.errors import UserError
from avatar.files.names import typed
from avatar.files.video import video_writer
from avatar.pipeline import OK
from data_prep.live.picture_sources import FILMED, Newest, open_source
from data_prep.live.recording_guidance import ENDS, PROMPTS, RecordingAdvice, Seen, measures, reaches
from data_prep.live.video_recorder import WARM_UP, VideoRecorder
from data_prep.track.faces.detect import FaceDetector

SUFFIXES = (".mp4", ".mov", ".mkv")
OFTEN = 0.05  # share of the pictures above which what was wrong is named at the end


class Screen:
    """Lines that stay, and a last one that is rewritten; where no terminal shows it, what changes in it is printed."""

    def __init__(self) -> None:
        self._is_terminal, self._last = sys.stdout.isatty(), ""

    def say(self, words: str, bell: str = "") -> None:
        print(f"\r\x1b[K{words}{bell}" if self._is_terminal else words, flush=True)

    def rewrite(self, words: str, left: str = "") -> None:
        """`left`: what a terminal shows before them."""
        if self._is_terminal:
            print(f"\r\x1b[K{left:>7}  {words}", end="", flush=True)
        elif words and words != self._last:
            print(f"         {words}", flush=True)
        self._last = words


def run_record(arguments: Namespace) -> int:
    out: Path = arguments.out
    check_outputs([out], [Path(arguments.webcam)])
    if out.exists() or out.is_symlink():
        raise UserError(f"{out} exists already; give another name, or remove it")
    check_file(out, SUFFIXES, "a film")
    screen, seen, wrong = Screen(), list[Seen](), Counter[str]()
    with interruption(second_acts=False) as interrupted, FaceDetector() as detector:
        film = VideoRecorder(open_source(arguments.webcam, FILMED))
        with closing(Newest(film)) as newest:
            screen.say(
                f"Camera   {film.name}, {film.size[0]} x {film.size[1]} pixels. Ctrl-C ends, and keeps the film."
            )
            rate = wait_for_face(newest, film, detector, screen, interrupted)
            with video_writer(out, rate, "veryfast") as add:
                film.begin(add, rate)
                try:
                    follow_prompts(newest, detector, screen, seen, wrong, interrupted)
                except KeyboardInterrupt:
                    screen.say("Stopped.")
                except UserError as error:
                    screen.say(f"Stopped: {error}")
                finally:
                    film.end()
    screen.say(f"Film     {out}")
    report(screen, film, seen, wrong)
    screen.say(f"Next     avatar create {typed(out)} --head flame/")
    return OK


def between_pictures(interrupted: Callable[[], bool]) -> None:
    """Raise KeyboardInterrupt here: within MediaPipe it can end the process."""
    if interrupted():
        raise KeyboardInterrupt


def wait_for_face(
    newest: Newest, film: VideoRecorder, detector: FaceDetector, screen: Screen, interrupted: Callable[[], bool]
) -> float:
    """The camera's rate, once that is known and a face there. Raises UserError when the pictures end before."""
    newest.start()
    try:
        while True:
            between_pictures(interrupted)
            faces, rate = detector.find(newest.take().image), film.measured_rate()
            if faces and rate is not None:
                return rate
            screen.rewrite("Measuring the rate." if faces else "There is no face in the picture.")
    except UserError as error:
        raise UserError(f"{error}; nothing was filmed: that begins with a face, after {WARM_UP:g} s") from None


def follow_prompts(
    newest: Newest,
    detector: FaceDetector,
    screen: Screen,
    seen: list[Seen],
    wrong: Counter[str],
    interrupted: Callable[[], bool],
) -> None:
    """Say each prompt in its time and what is wrong with the pictures; `seen` and `wrong` get what was seen and said."""
    adviser, begin, shown = RecordingAdvice(), None, -1
    while True:
        between_pictures(interrupted)
        picture = newest.take()
        begin = picture.taken if begin is None else begin
        time = picture.taken - begin
        if (number := bisect_right(ENDS, time)) == len(PROMPTS):
            return
        if number != shown:
            shown = number
            screen.say(f"{number + 1:2} of {len(PROMPTS)} {PROMPTS[number].words}", bell="\a")
        face = next(iter(detector.find(picture.image)), None)
        if face is not None:
            seen.append(Seen(time, measures(face)))
        wrong[problem := adviser.advise(picture.image, face, time)] += 1
        screen.rewrite(problem, f"{ENDS[number] - time:.0f} s")


def report(screen: Screen, film: VideoRecorder, seen: list[Seen], wrong: Counter[str]) -> None:
    """The film's length and rate, what was wrong with the pictures, and what each prompt reached."""
    slow = "; more light: cameras slow down in the dark" if film.repeated > OFTEN * film.frames else ""
    screen.say(
        f"         {film.frames / film.rate:.1f} s at {film.rate:g} pictures a second; missing ones repeated: "
        f"{film.repeated}, early ones left out: {film.left_out}{slow}"
    )
    for problem, count in wrong.most_common():
        if problem and count > OFTEN * wrong.total():
            screen.say(f"Picture  {100 * count / wrong.total():.0f} % of the time: {problem}")
    for prompt, reached in zip(PROMPTS, reaches(seen), strict=True):
        got = {} if reached is None else reached
        figures = ", ".join(
            f"{name} {got[name]:.2g} of {least:g}" for name, least in prompt.least.items() if name in got
        )
        is_enough = reached is not None and all(got[name] >= least for name, least in prompt.least.items())
        screen.say(f"{'Reached' if is_enough else 'Repeat':8} {prompt.words} {figures if got else ''}".rstrip())
