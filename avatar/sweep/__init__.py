"""Many trainings as one: subjects, configurations and seeds, on engines that exist. State is files, and nothing else."""
