"""`avatar check`: everything about a tracked folder that could spoil training, found before training.

`read_clip` reads the folder once and gathers what does not work; the `check_*` functions turn what was read into findings.
"""
