"""From a tracked folder to a prepared subject: frames paired with their tracking, masks and rates found, flaws said."""
