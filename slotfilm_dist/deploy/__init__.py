"""Taking a trained policy to where neither the simulator nor Ray is installed."""
