"""One person's face followed while it moves: pictures as they come, the newest first."""
