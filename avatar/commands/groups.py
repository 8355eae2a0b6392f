"""The commands in groups: what each does, and what is typed after it for example."""

from __future__ import annotations

GROUPS = {
    "From a video to a page": {
        "create": ("make an avatar's page from a video: track, train, evaluate, export", "me.mp4 --head flame/ --open"),
        "record": ("film yourself with the webcam, as the screen tells you", "me.mp4"),
        "track": ("track a face through a video, and write a folder to train on", "me.mp4 --head flame/ --out me"),
        "check": ("say everything that is wrong with a tracked folder, before training", "me --out me-check"),
        "train": ("train an avatar on a tracked video folder, or on a video", "me --out runs/me"),
        "eval": ("measure a trained avatar on the held-out frames", "runs/me"),
        "refine": ("improve the tracking of a run's video through its avatar", "runs/me"),
    },
    "With an avatar": {
        "view": ("show an avatar in a browser, move it by hand and drive it live", "runs/me --webcam"),
        "reenact": ("drive an avatar with another person's motion", "runs/me other.mp4 --out reenacted.mp4"),
        "export": ("write an avatar as a file to take away", "runs/me --out me.html"),
        "drive-file": ("write a tracked folder's motion as a drive file", "other --out other.npz"),
    },
    "Several runs": {
        "report": ("write a run as one HTML page: figures, frames, curves, configuration", "runs/me"),
        "compare": ("set evaluated runs side by side, with differences to the first", "runs/me runs/paper"),
        "sweep": ("train and measure many subjects, configurations and seeds", "ablation.yaml --workers 2"),
    },
    "Try it": {
        "demo": ("make two subjects, train on one, evaluate, reenact with the other", "demo"),
        "demo-data": ("make a talking-head subject, tracking and head model included", "anna --seed 1"),
        "prepare": ("check and import a tracked folder; train does it by itself", "me"),
    },
    "This machine": {
        "doctor": ("say what this installation can do and what is missing", ""),
        "models": ("list the files of others that the program can use, and where they are", "--download"),
        "bench": ("measure time and error of a part on this machine", "splat --quick"),
        "completion": ("print what completes commands in your shell", "bash >> ~/.bashrc"),
    },
}


def list_commands() -> str:
    """Every command with its meaning and an example."""
    lines = ["To begin: avatar demo OUT, or avatar create VIDEO. avatar COMMAND --help lists a command's options."]
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:"]
        for name, (meaning, example) in commands.items():
            lines += [f"  {name:<11} {meaning}", f"{'':14}avatar {name} {example}".rstrip()]
    return "\n".join(lines)
