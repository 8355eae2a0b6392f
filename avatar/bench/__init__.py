"""Measurements of the program's own speed and accuracy: `avatar bench PART`."""

# Each module has run(out: Path, *, quick: bool, full: bool) -> None, which prints a table and writes files into `out`, a
# folder that exists. `quick` checks the measurement itself in seconds; `full` is the long sweep, where there is one.
PARTS = {
    "splat": "avatar.bench.splat_report",
}
