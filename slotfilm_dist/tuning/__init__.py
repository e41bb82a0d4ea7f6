"""The study as a grid of trials on Ray Tune."""
