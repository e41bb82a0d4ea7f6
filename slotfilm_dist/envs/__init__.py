"""Simulated tasks: scenes, rewards, observations and the wrist camera. The only package that imports the simulator."""
