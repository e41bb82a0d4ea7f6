"""A distributed actor-learner system for egocentric robot manipulation with state-guided slot attention."""

__version__ = "0.1.0"
