"""Scripts that run what ours is compared with, each in a child process; `serving` is what they answer through."""
