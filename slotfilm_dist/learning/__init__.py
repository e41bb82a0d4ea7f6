"""Losses, the SAC learner and slot pre-training."""
