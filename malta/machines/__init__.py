"""The machines that come with malta, each a folder: plant, experiments, figures, claims."""
