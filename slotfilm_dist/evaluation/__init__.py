"""What a trained agent can do, what it sees and what it costs."""
