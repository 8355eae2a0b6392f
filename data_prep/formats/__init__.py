"""Tracked folders as other programs write them: one file a program; `detect` tells them apart."""
