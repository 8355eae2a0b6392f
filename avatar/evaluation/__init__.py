"""What a trained avatar is worth: figures by written-down protocols, and comparisons of runs."""
