"""A study's report: many runs, variant by variant and seed by seed, set beside what the paper printed."""
